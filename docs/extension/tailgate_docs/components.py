"""A page for every component, from its card, its class and the files that name it."""

import inspect
import json
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from pydantic import TypeAdapter
from pydantic.errors import PydanticUserError

from tailgate.core.registry import Entry, Family, entries
from tailgate.core.scenario import Scenario, Suite, list_scenarios, list_suites, load_scenario, load_suite
from tailgate.core.schema import as_data, fields_of
from tailgate.play.metrics import METRICS, UNITS

from .docstrings import escaped, markdown, summary
from .usage import clean_run, usage

TITLES: dict[str, tuple[str, str]] = {
    "defence": ("Defences", "Methods that turn what is received into an estimate, a score and an alarm."),
    "filter": ("Filters", "Estimates from readings: parts of a defence, `composed:filter=NAME`."),
    "detector": ("Detectors", "Alarms from innovations: parts of a defence, `composed:detector=NAME`."),
    "mitigation": ("Mitigations", "Responses to an alarm: parts of a defence, `composed:mitigation=NAME`."),
    "attack": ("Attacks", "Scripts, white boxes, computed optima and learned policies."),
    "plant": ("Plants", "Moving systems: vehicles, platoons, networks."),
    "sensor": ("Sensors", "Measurements of a plant's agents."),
    "controller": ("Controllers", "Drivers: commands from an estimate."),
    "manoeuvre": ("Manoeuvres", "Driving of the leader."),
    "reward": ("Rewards", "Payments of the adversary in an environment."),
    "learner": ("Learners", "Algorithms that train an adversary."),
}
MANY = 1e9  # a bound from here on only keeps arithmetic finite
_UNIT = re.compile(r"\s*\[([^\]]+)\]")


def _ranges(schema: dict[str, Any], whole: dict[str, Any]) -> Iterator[str]:
    """Yield what a JSON schema admits, in words."""
    if "$ref" in schema:
        yield from _ranges(whole["$defs"][schema["$ref"].rsplit("/", 1)[1]], whole)
    elif "anyOf" in schema:
        for one in schema["anyOf"]:
            yield from _ranges(one, whole)
    elif "enum" in schema or "const" in schema:
        yield ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    elif schema.get("type") == "array":
        items = schema.get("prefixItems") or [schema.get("items", {})]
        each = dict.fromkeys(text for item in items for text in _ranges(item, whole))
        number = f"{schema['maxItems']} values" if "maxItems" in schema and schema.get("minItems") == schema["maxItems"] else "a list"
        yield f"{number}: {', '.join(each)}" if any(each) else number
    elif schema.get("type") in ("number", "integer"):
        kind = "integer" if schema["type"] == "integer" else "number"
        bounds = [("from", "minimum"), ("above", "exclusiveMinimum"), ("to", "maximum"), ("below", "exclusiveMaximum")]
        said = [f"{word} {schema[key]:g}" for word, key in bounds if key in schema and abs(schema[key]) < MANY]
        yield " ".join([kind, *said])
    elif schema.get("type") == "null":
        yield "none"
    elif "type" in schema:
        yield {"boolean": "true or false", "string": "text", "object": "a mapping"}.get(schema["type"], schema["type"])


def admitted(cls: type, name: str) -> str:
    """Return the values that a parameter of a component may have, as its type says."""
    try:
        hint = get_type_hints(cls, include_extras=True)[name]
        schema = TypeAdapter(hint).json_schema()
    except (PydanticUserError, NameError, KeyError):
        return "an object"
    return " or ".join(dict.fromkeys(_ranges(schema, schema))) or "a name, or a mapping with name and parameters"


def cell(text: str) -> str:
    """Return text as a cell of a table."""
    return " ".join(text.split()).replace("|", r"\|")


def _parameters(cls: type) -> list[str]:
    rows = []
    for name, field in fields_of(cls).items():
        said = str(field.metadata.get("doc", ""))
        units = _UNIT.findall(said)
        words = escaped(_UNIT.sub("", said)) if len(units) == 1 else escaped(said)
        unit = units[0] if len(units) == 1 else "see text" if units else ""
        default = json.dumps(as_data(field.default)) if field.default is not inspect.Parameter.empty else ""
        rows.append(f"| `{name}` | {cell(words)} | {cell(escaped(unit))} | {cell(admitted(cls, name))} | `{cell(default)}` |")
    if not rows:
        return ["It has no parameters.", ""]
    return ["| parameter | meaning | unit | range | default |", "|---|---|---|---|---|", *rows, ""]


def where(cls: Any, root: Path) -> tuple[str, int]:
    """Return file, as the repository has it, and line of a class or function."""
    path = Path(inspect.getfile(cls)).resolve()
    return str(path.relative_to(root)), inspect.getsourcelines(cls)[1]


def described(directive: str, name: str, module: str, body: str, fence: str = "`" * 6, options: tuple[str, ...] = ()) -> list[str]:
    """Return an entry of the Python domain, whose text is Markdown."""
    return [f"{fence}{{py:{directive}}} {name}", f":module: {module}", *options, "", body, fence, ""]


class Pages:
    """All pages of components, as paths below a folder and their texts."""

    def __init__(self, root: Path, families: Sequence[Family] = get_args(Family)) -> None:
        self.root = root
        self.scenarios: dict[str, Scenario] = {name: load_scenario(name) for name in list_scenarios()}
        self.suites: dict[str, Suite] = {name: load_suite(name) for name in list_suites()}
        self.entries = {family: entries(family) for family in families}

    def all(self) -> dict[str, str]:
        """Return path -> Markdown of every page."""
        out: dict[str, str] = {}
        for family, group in self.entries.items():
            for name, entry in group.items():
                out[f"{family}/{name}.md"] = self._component(entry)
            title, about = TITLES[family]
            rows = [(name, summary(sys.modules[e.cls.__module__] if family == "learner" else e.cls)) for name, e in group.items()]
            out[f"{family}/index.md"] = self._index(title, about, rows)
        for name, place in self.scenarios.items():
            out[f"scenario/{name}.md"] = self._scenario(name, place)
        for name, suite in self.suites.items():
            out[f"suite/{name}.md"] = self._suite(name, suite)
        about = "A scenario is a plant, a sensor, a controller, a manoeuvre and a threat model, under a name with a version."
        out["scenario/index.md"] = self._index("Scenarios", about, [(n, cell(escaped(s.about))) for n, s in self.scenarios.items()])
        about = "A suite is scenarios, doses, attacks and gates, under a name with a version: what a board plays."
        out["suite/index.md"] = self._index("Suites", about, [(n, cell(escaped(s.about))) for n, s in self.suites.items()])
        for name in METRICS:
            out[f"metric/{name}.md"] = self._metric(name)
        about = "Columns of a row: what one episode came to. Where a quantity is undefined, the row says `null`."
        out["metric/index.md"] = self._index("Metrics", about, [(n, f"{summary(f)} {cell(escaped(f'[{UNITS[n]}]'))}") for n, f in METRICS.items()])
        return out

    @staticmethod
    def _index(title: str, about: str, rows: list[tuple[str, str]]) -> str:
        table = [f"| [{name}]({name}.md) | {said} |" for name, said in rows]
        return "\n".join([f"# All {title.lower()}", "", about, "", "| name | what it is |", "|---|---|", *table, ""])

    def _component(self, entry: Entry) -> str:
        file, line = where(entry.cls, self.root)
        facts = [("family", f"[{TITLES[entry.family][0].lower()}](index.md)"), ("version", str(entry.version)), ("class", f"`{entry.cls.__module__}.{entry.cls.__qualname__}`")]
        facts.append(("file", f"`{file}`, line {line}"))
        if entry.reference:
            facts.append(("reference", escaped(entry.reference)))
        if entry.family == "defence":
            facts.append(("reads", ", ".join(entry.uses)))
        if entry.family == "attack":
            facts.append(("knowledge", f"{entry.knowledge} box" + (", a computed optimum" if entry.optimal else "")))
        if entry.sentinel:
            facts.append(("sentinel", escaped(entry.sentinel)))
        places = self._played(entry)
        held: object = sys.modules[entry.cls.__module__] if entry.family == "learner" else entry.cls  # a module is one algorithm
        text = [f"# {entry.name} ({entry.family})", "", markdown(held), "", "| | |", "|---|---|", *(f"| {k} | {cell(v)} |" for k, v in facts), ""]
        text += ["## Parameters", "", *_parameters(getattr(held, "Config", entry.cls)), "## Use", "", *usage(entry, places)]
        text += self._links("Played in", "scenario", places if entry.family not in ("defence", "attack") else [])
        text += self._links("On the suites", "suite", self._listed(entry))
        text += ["## Class", "", *described("class", entry.cls.__qualname__, entry.cls.__module__, "")]
        return "\n".join(text)

    def _links(self, title: str, kind: str, names: list[str]) -> list[str]:
        if not names:
            return []
        return [f"## {title}", "", ", ".join(f"[{name}](../{kind}/{name}.md)" for name in names), ""]

    def _played(self, entry: Entry) -> list[str]:
        """Return scenarios that have this component; of a defence or an attack, those of the first suite that lists it."""
        if entry.family in ("defence", "attack"):
            return [place for name in self._listed(entry) for place in self.suites[name].scenarios][:1]
        return [name for name, place in self.scenarios.items() if type(getattr(place, entry.family, None)) is entry.cls]

    def _listed(self, entry: Entry) -> list[str]:
        if entry.family not in ("defence", "attack"):
            return []
        held = {name: getattr(suite, f"{entry.family}s") for name, suite in self.suites.items()}
        return [name for name, texts in held.items() if any(re.split("[:,]", str(text))[0] == entry.name for text in texts)]

    def _scenario(self, name: str, place: Scenario) -> str:
        text = [f"# {name} (scenario)", "", escaped(place.about), "", "## Parts", "", "| part | component | parameters |", "|---|---|---|"]
        for family in ("plant", "sensor", "controller", "manoeuvre"):
            part = getattr(place, family)
            known = next((n for n, e in self.entries[family].items() if e.cls is type(part)), None)
            shown = ", ".join(f"`{key}` {json.dumps(as_data(getattr(part, key)))}" for key in fields_of(type(part)))
            text.append(f"| {family} | " + (f"[{known}](../{family}/{known}.md)" if known else type(part).__name__) + f" | {cell(shown)} |")
        text += ["", f"[All scenarios](index.md). An episode has {place.horizon} steps of {place.brief().model.dt:g} s.", ""]
        if place.truth:
            text += ["What defence and attacker do not know, `truth`:", "", "```json", json.dumps(as_data(place.truth)), "```", ""]
        rows = [f"| `{key}` | `{cell(json.dumps(as_data(getattr(place.threat_model, key))))}` |" for key in fields_of(type(place.threat_model))]
        text += ["## Threat model", "", "| field | value |", "|---|---|", *rows, ""]
        text += ["## Use", "", *clean_run(name)]
        text += self._links("On the suites", "suite", [n for n, suite in self.suites.items() if name in (*suite.scenarios, *suite.robustness)])
        return "\n".join(text)

    def _metric(self, name: str) -> str:
        function = METRICS[name]
        file, line = where(function, self.root)
        facts = [("family", "[metrics](index.md)"), ("unit", escaped(UNITS[name])), ("file", f"`{file}`, line {line}")]
        use = ["```python", "import tailgate", "", 'rows = tailgate.evaluate("quick-v0", defences=["kf"], seeds=5)', f'[row["{name}"] for row in rows]', "```", ""]
        entry = described("function", f"{name}(trace)", function.__module__, "")
        table = [f"| {key} | {value} |" for key, value in facts]
        return "\n".join([f"# {name} (metric)", "", markdown(function), "", "| | |", "|---|---|", *table, "", "## Use", "", *use, "## Function", "", *entry])

    def _suite(self, name: str, suite: Suite) -> str:
        def linked(kind: str, texts: Any) -> str:
            known = self.entries.get(kind, {}) if kind != "scenario" else self.scenarios
            out = []
            for text in map(str, texts):
                head = re.split("[:,]", text)[0]
                out.append(f"[`{text}`](../{kind}/{head}.md)" if head in known else f"`{text}`")
            return ", ".join(out) or "-"

        rows = [
            ("kind", "[suite](index.md)"), ("scenarios", linked("scenario", suite.scenarios)), ("doses [steps]", ", ".join(map(str, suite.doses)) or "-"),
            ("seeds", str(suite.seeds)), ("defences", linked("defence", suite.defences)), ("attacks", linked("attack", suite.attacks)),
            ("robustness scenarios", linked("scenario", suite.robustness)),
        ]  # fmt: skip
        table = [f"| {key} | {cell(value)} |" for key, value in rows]
        use = ["```console", f"tailgate leaderboard run {name} --out boards", "```", ""]
        return "\n".join([f"# {name} (suite)", "", escaped(suite.about), "", "| | |", "|---|---|", *table, "", "## Use", "", *use])
