"""The card of an entry: its authors' words, next to the figures that they do not choose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tailgate.base.errors import InputError, unknown
from tailgate.core import param
from tailgate.core.registry import USES
from tailgate.core.schema import as_data, build

from .files import read_json
from .schema import Data


@dataclass(frozen=True)
class Card:
    """One JSON file per entry. Nothing in it changes a figure."""

    kind: Literal["defence", "attack"] = param("defence", "defence or attack")
    text: str = param("", "the entry as it is named in rows")
    name: str = param("", "its name as people say it")
    authors: str = param("", "who made it")
    reference: str = param("", "paper, with a link or DOI")
    code: str = param("", "link to the code, https")
    licence: str = param("", "licence of the code, as an SPDX identifier")
    uses: tuple[str, ...] = param((), "what a defence uses: the words of its class; what an attack knows is in its rows")
    threat_model: str = param("", "what the authors defend against, or what an attack assumes, in one sentence")
    training: str = param("", "training budget: decisions or hours, hardware, seeds; `none`")
    digest: str = param("", "of the submission, as `leaderboard submit --digest` prints it; empty for what comes with the package")

    def check(self, where: str) -> None:
        """Raise InputError for a field that is missing or makes no sense."""
        for field in ("text", "name", "licence", "threat_model", "training"):
            if not getattr(self, field).strip():
                raise InputError(f"{where}.{field}", getattr(self, field), "some text")
        if self.code and not self.code.startswith("https://"):
            raise InputError(f"{where}.code", self.code, "a link that begins with https://")
        for use in self.uses:
            if use not in USES or use == "truth":
                raise unknown(f"{where}.uses", use, [u for u in USES if u != "truth"])


def read_card(path: Path) -> Card:
    """Return a card, checked. Raises InputError that names the field."""
    where = f"card {path.name}"
    data = read_json(path, where)
    if not isinstance(data, dict):
        raise InputError(where, data, "a mapping of fields")
    card = build(Card, data, where)
    card.check(where)
    return card


def with_cards(board: Data, folder: Path) -> Data:
    """Return the board with what the cards of a folder say of its defences and attacks. Raises InputError for two cards of one entry."""
    cards: dict[tuple[str, str], Data] = {}
    for path in sorted(folder.glob("*.json")):
        card = read_card(path)
        if (card.kind, card.text) in cards:
            raise InputError(f"card {path.name}", card.text, "an entry that has no other card")
        cards[card.kind, card.text] = {key: value for key, value in as_data(card).items() if value and key not in ("class", "kind", "text")}

    def carded(kind: str, line: Data) -> Data:
        card = cards.get((kind, line[kind]))
        return line if card is None else line | {"card": (line.get("card") or {}) | card}

    return board | {"entries": [carded("defence", e) for e in board["entries"]], "attacks": [carded("attack", a) for a in board["attacks"]]}
