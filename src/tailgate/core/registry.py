"""Names to components. A component is a frozen dataclass; its fields are its parameters.

Built-in ones register where they are defined; others come from entry points (`GROUPS`), from `module:Class` on the command line,
or as objects in Python. A configuration file names registered components only.
"""

import hashlib
import importlib
import inspect
import json
import operator
import warnings
from collections.abc import Callable, Iterable
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, TypedDict, TypeVar, Unpack

from tailgate.base import own_modules
from tailgate.base.errors import InputError, unknown
from tailgate.base.lazy import components, loaded
from tailgate.core.foreign import class_of, unregistered, with_place
from tailgate.core.schema import as_data, build, fields_of, scalar
from tailgate.core.spec_text import put_in, split_items, split_text

Family = Literal["defence", "filter", "detector", "mitigation", "attack", "plant", "sensor", "controller", "manoeuvre", "reward", "learner"]
USES = ("measurements", "odometry", "probe", "v2v", "redundant", "leader_input", "truth")
_MODULES = {
    "defence": "tailgate.estimators",
    "filter": "tailgate.estimators",
    "detector": "tailgate.estimators",
    "mitigation": "tailgate.estimators",
    "attack": "tailgate.agents",
    "plant": "tailgate.envs",
    "sensor": "tailgate.envs",
    "controller": "tailgate.envs",
    "manoeuvre": "tailgate.envs",
    "reward": "tailgate.envs",
    "learner": "tailgate.agents",
}
GROUPS: dict[str, str] = {family: f"tailgate.{family}s" for family in _MODULES if family != "learner"} | {
    "defence": "tailgate.estimators", "attack": "tailgate.agents", "metric": "tailgate.metrics",
}  # fmt: skip
SANDBOXES = ("bwrap", "docker")
_FILES = {".json": "policy", ".yaml": "program", ".yml": "program"}  # attacks that are files
PARTS: tuple[Family, ...] = ("filter", "detector", "mitigation")  # of the defence `composed`
IMPORTED: tuple[Family, ...] = ("defence", "attack", *PARTS)  # families of which module:Class may be named
_entries: dict[str, dict[str, "Entry"]] = {family: {} for family in _MODULES}
_plugins_loaded: set[str] = set()
T = TypeVar("T", bound=type)


class Card(TypedDict, total=False):
    """The fields of `Entry` that a component gives at its registration."""

    version: int
    reference: str
    uses: tuple[str, ...]
    knowledge: str
    optimal: bool
    sentinel: str


@dataclass(frozen=True)
class Entry:
    """A registered component, as its card shows it."""

    family: Family
    name: str
    cls: type
    version: int = 1
    reference: str = ""
    uses: tuple[str, ...] = ("measurements",)
    knowledge: str = "black"
    optimal: bool = False
    sentinel: str = ""

    @property
    def built_in(self) -> bool:
        """True if it comes with this package; a plug-in is somebody else's code under a name."""
        return self.cls.__module__.partition(".")[0] == "tailgate"

    @property
    def learned(self) -> bool:
        """True if this attack plays trained policies."""
        return bool(getattr(self.cls, "learned", False))

    @property
    def summary(self) -> str:
        return summary_of(self.cls)

    def card(self) -> dict[str, Any]:
        """Return JSON data: name, version, reference, uses and every parameter with its default and sentence."""
        params = {
            name: {"default": as_data(f.default), "doc": f.metadata.get("doc", "")} for name, f in fields_of(self.cls).items()
        }
        out: dict[str, Any] = {"name": self.name, "version": self.version, "summary": self.summary, "reference": self.reference}
        if self.family == "defence":
            out |= {"uses": list(self.uses), "sentinel": self.sentinel}
        if self.family == "attack":
            out |= {"knowledge": self.knowledge, "optimal": self.optimal, "learned": self.learned}
        return out | {"parameters": params}


def summary_of(value: object) -> str:
    """Return the first paragraph of a docstring in one line."""
    return (inspect.getdoc(value) or "").split("\n\n")[0].replace("\n", " ")


def register(family: Family, name: str, **card: Unpack[Card]) -> Callable[[T], T]:
    """Return a class decorator that registers a component. Reusing a name is an error."""

    def add(cls: T) -> T:
        put(Entry(family, name, cls, **card))
        return cls

    return add


def check_uses(name: str, uses: Iterable[str]) -> None:
    """Raise InputError for a use that the loop does not know."""
    for use in uses:
        if use not in USES:
            raise unknown(f"{name}.uses", use, USES)


def put(entry: Entry) -> None:
    """Add an entry; raise InputError for a taken name or an unknown use."""
    check_uses(entry.name, entry.uses)
    held = _entries[entry.family].get(entry.name)
    if held is not None and held.cls is not entry.cls:
        raise InputError(f"{entry.family} name", entry.name, "a name that is not taken")
    _entries[entry.family][entry.name] = entry


def _at_home(family: Family, name: str) -> Entry | None:
    """Return a built-in component after importing its own module alone; None where no module registers it."""
    if name not in _entries[family] and (module := components(_MODULES[family]).get((family, name))):
        importlib.import_module(module)
    return _entries[family].get(name)


def built_in(family: Family) -> dict[str, Entry]:
    """Return the components that come with this package, by name; import nobody else's."""
    loaded(_MODULES[family], family)
    return {name: entry for name, entry in _entries[family].items() if entry.built_in}


def _load(family: Family) -> dict[str, Entry]:
    built_in(family)
    group = GROUPS.get(family)
    if group and group not in _plugins_loaded:
        for point in entry_points(group=group):
            try:
                entry = entry_of(family, point.name, fitting(family, point.load()))
            except Exception as error:  # somebody's broken package shall not stop those who do not use it
                warnings.warn(f"plug-in {point.name!r} of {group} cannot be loaded: {error}", stacklevel=2)
                continue
            put(entry)
        _plugins_loaded.add(group)  # only now: a name that is taken is an error each time
    return _entries[family]


@cache
def _plugged(points: Callable[..., Any], group: str) -> frozenset[str]:
    """Return names of the plug-ins of a group; reading them reads all installed packages."""
    return frozenset(point.name for point in points(group=group))


METHODS: dict[str, tuple[str, ...]] = {  # of a class; `tailgate.core.components` says what they get and give
    "defence": ("prepare", "start", "step"), "attack": ("prepare", "start", "decide"),
    "plant": ("model", "prepare", "start", "step", "scene"), "sensor": ("matrices", "prepare", "measure"),
    "controller": ("prepare", "start", "step"), "manoeuvre": ("prepare", "start", "accel"), "reward": ("terms",),
}  # fmt: skip


def fitting(family: Family, value: object) -> type:
    """Return a class that has the methods of its family. Raises InputError for anything else."""
    methods = METHODS.get(family, ())
    if not isinstance(value, type) or not all(callable(getattr(value, name, None)) for name in methods):
        raise InputError(family, value, f"a class with {', '.join(methods)}" if methods else "a class")
    return value


def entry_of(family: Family, name: str, cls: type) -> Entry:
    """Return an entry for somebody else's class, which may carry `uses`, `reference` and `version` as class attributes."""
    uses, version = getattr(cls, "uses", ("measurements",)), getattr(cls, "version", 1)
    if isinstance(uses, str) or not isinstance(uses, Iterable) or not all(isinstance(use, str) for use in uses):
        raise InputError(f"{name}.uses", uses, "several names, such as ('measurements', 'v2v')")
    check_uses(name, uses := tuple(sorted(uses) if isinstance(uses, AbstractSet) else uses))
    if not hasattr(version, "__index__"):
        raise InputError(f"{name}.version", version, "a whole number")
    return Entry(
        family, name, cls, version=operator.index(version), reference=str(getattr(cls, "reference", "")), uses=uses,
        knowledge=str(getattr(cls, "knowledge", "black")),
    )  # fmt: skip


def entry_for(family: Family, cls: type) -> Entry:
    """Return the entry under which a class is registered, or one made of its attributes."""
    for entry in _load(family).values():
        if entry.cls is cls:
            return entry
    return entry_of(family, cls.__name__, cls)


def text_of(entry: Entry, value: object) -> str:
    """Return the text that names this object on a command line, as far as a text can."""
    cls = type(value)
    name = entry.name if _entries[entry.family].get(entry.name) is entry else f"{cls.__module__}:{cls.__qualname__}"
    params = as_data(value)
    if not isinstance(params, dict):
        return name
    shown = [f"{key}={json.dumps(held)}" for key, held in params.items() if key != "class"]
    return f"{name}:{','.join(shown)}" if shown else name


def entries(family: Family) -> dict[str, Entry]:
    """Return every registered component of a family by name, plug-ins included."""
    return dict(sorted(_load(family).items()))


def find(family: Family, name: str) -> Entry:
    """Return the entry of a name; raise InputError that lists the known ones."""
    if found := _at_home(family, name):
        return found
    known = _load(family)
    if name not in known:
        raise unregistered(family, name, known, family in IMPORTED)
    return known[name]


def make(family: Family, name: str, /, **params: object) -> Any:
    """Return a component by name, its parameters validated."""
    if not isinstance(name, str):
        raise InputError(f"{family}.name", name, "the name of a registered component")
    entry = find(family, name)
    return build(entry.cls, params, f"{family} {name}")


def make_from(family: Family, data: object, where: str) -> Any:
    """Return a component from configuration data: a name, or a mapping with `name` and parameters."""
    if isinstance(data, str):
        data = {"name": data}
    if not isinstance(data, dict) or "name" not in data:
        raise InputError(where, data, "a name, or a mapping with a name and parameters")
    return make(family, data["name"], **{key: value for key, value in data.items() if key != "name"})


@dataclass(frozen=True)
class Spec:
    """A component as a user names it: text that a row can record and another process can rebuild.

    `name`, `name:key=value,key=value`, `module:Class`, `module:Class:key=value`, or (attacks) the JSON file of a policy or the YAML file of
    a program. `part.key=value` is a parameter of a part that another parameter names. `bwrap/module:Class` is a defence in a sandbox.
    """

    family: Family
    text: str

    def _parts(self) -> tuple[str, dict[str, Any]]:
        head, tail = split_text(self.text)
        params: dict[str, Any] = {}
        for item in split_items(tail) if tail else ():
            key, eq, value = item.partition("=")
            if not eq:
                raise InputError(self.family, self.text, "name:key=value,key=value")
            put_in(params, key.strip(), scalar(value))
        return head, params

    def named(self) -> list[tuple[Family, str]]:
        """Return family and name of the component and of its parts."""
        head, params = self._parts()
        named: list[tuple[Family, Any]] = [(self.family, head)]
        for part in PARTS:
            held = params.get(part)
            named.append((part, held.get("name") if isinstance(held, dict) else held))
        return [(family, name) for family, name in named if isinstance(name, str)]

    def _imported(self) -> list[tuple[Family, str]]:
        """Return family and module:Class of everything that this text imports."""
        return [(family, name) for family, name in self.named() if ":" in name]

    def _plugged(self) -> list[tuple[Family, str]]:
        """Return family and name of every plug-in that this text names, as a part too."""
        return [(family, name) for family, name in self.named() if name in _plugged(entry_points, GROUPS[family])]

    def refuse_imports(self, where: str) -> None:
        """Raise InputError when this names a class to import: configuration files never run code."""
        if self.imports:
            other = "or a class in a sandbox (bwrap/module:Class)" if self.family == "defence" else "a program (YAML) or a policy (JSON)"
            raise InputError(f"{where}: {self.family}", self.text, f"a registered name, {other}: a configuration imports nothing")

    @property
    def sandboxed(self) -> tuple[str, str] | None:
        """Sandbox and class of a defence that is imported in a sandbox and nowhere else: `bwrap/module:Class`, `docker:IMAGE/...`."""
        program, slash, text = self.text.partition("/")
        found = slash and self.family == "defence" and program.partition(":")[0] in SANDBOXES
        return (program, text) if found else None

    @property
    def target(self) -> str:
        """The component itself, wherever it is played."""
        return self.sandboxed[1] if self.sandboxed else self.text

    @property
    def entry(self) -> Entry:
        if self.sandboxed:
            from tailgate.sandbox.sandboxed import entry_of as card_of

            return card_of(*self.sandboxed)
        head, _ = self._parts()
        if self.family == "attack" and (kind := _FILES.get(Path(head).suffix)):
            return find("attack", kind)
        if ":" not in head:
            return find(self.family, head)
        return imported(self.family, head)

    @property
    def imports(self) -> bool:
        """True if this names a class to import, outside of any sandbox."""
        return not self.sandboxed and bool(self._imported())

    @property
    def foreign(self) -> bool:
        """True if playing this runs somebody else's code outside of any sandbox: a class to import, or a plug-in."""
        return self.imports or (not self.sandboxed and bool(self._plugged()))

    @property
    def digest(self) -> str:
        """The hash of the files of somebody else's component or a zoo's policy; empty for other registered ones, which carry a version."""
        if self.sandboxed:
            from tailgate.sandbox.sandboxed import digest_of

            return digest_of(self.sandboxed[1])
        head, params = self._parts()
        paths = [path for family, name in self._imported() for path in own_modules.files_of(imported(family, name).cls)]
        paths += [path for family, name in self._plugged() if family in PARTS for path in own_modules.files_of(find(family, name).cls)]
        if self.family == "attack":
            paths = [Path(str(text)) for text in (head, params.get("path")) if Path(str(text)).suffix in _FILES] or paths
        if self.family == "defence" and (held := params.get("policy")) is not None:  # a defender that was trained
            paths += [Path(str(path)) for path in (held if isinstance(held, list) else [held])]
        if not paths and not self.entry.built_in:
            paths = own_modules.files_of(self.entry.cls)
        if not paths and hasattr(self.entry.cls, "sources"):  # a name of a file
            paths = list(self.make().sources)
        if self.family == "defence" and len(paths) == 1 and (":" in head or not self.entry.built_in):
            from tailgate.sandbox import source

            if told := source.digest_of_file(head.partition(":")[0] if ":" in head else self.entry.cls.__module__, paths[0]):
                return told  # as a submission's: rows of both are of one class
        blobs = [path.read_bytes() for path in paths if path.is_file()]
        return hashlib.sha256(b"".join(blobs)).hexdigest() if blobs else ""

    def make(self) -> Any:
        if self.sandboxed:
            from tailgate.sandbox.sandboxed import Sandboxed

            return Sandboxed(*self.sandboxed)
        head, params = self._parts()
        if self.family == "attack" and Path(head).suffix in _FILES:
            params = {"path": head, **params}
        try:
            made: Any = build(self.entry.cls, params, f"{self.family} {head}")
        except Exception as error:
            if isinstance(error, InputError) or self.entry.built_in:
                raise
            raise InputError(self.family, self.text, f"a class that can be made ({with_place(error)})") from None
        steps = METHODS[self.family] if self.family in ("defence", "attack") else ()
        if not all(callable(getattr(made, name, None)) for name in steps):
            raise InputError(self.family, self.text, f"a class with {', '.join(steps)}")
        if self.family == "defence" and _takes(made.step) < 5:
            raise InputError(
                self.family, self.text, "a class whose step takes plan, state, received, known_u and draws; a filter, detector or "
                "mitigation is a part: composed:detector=module:Class"
            )  # fmt: skip
        return made


def imported(family: Family, text: str) -> Entry:
    """Return the entry of a class that the user names as module:Class."""
    module = text.partition(":")[0]
    if module in _load(family):
        raise InputError(family, text, f"{module}:key=value,key=value")
    return entry_of(family, text, class_of(family, text))


def _takes(function: Callable[..., Any]) -> float:
    """Return how many arguments a method takes at most."""
    kinds = [p.kind for p in inspect.signature(function).parameters.values()]
    return float("inf") if inspect.Parameter.VAR_POSITIONAL in kinds else len(kinds)
