"""The nouns of a board's `searches`."""

from __future__ import annotations

from .part import Count, Dose, Level, Part, Share, Text


class SearchedMember(Part):
    """The best attack that a member found in a cell: its damage on select episodes, and its text where it is played."""

    member: Text
    knowledge: Level
    why: Text = ""  # why it found nothing
    damage: Share | None
    attack: Text | None


class SearchedCell(Part):
    """A search in a scenario at a dose."""

    scenario: Text
    dose: Dose
    listed: Share | None  # damage of the suite's best attack, on the same episodes
    members: list[SearchedMember]


class SearchedLine(Part):
    """The searches of the standard attack ensemble against a defence."""

    defence: Text
    digest: Text
    version: Count
    ensemble: Text
    budget: Text
    seed: Count = 0
    cells: list[SearchedCell]
