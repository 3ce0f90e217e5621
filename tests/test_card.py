"""Cards of entries: what their authors say."""

import json
import re
from pathlib import Path

import pytest
import yaml

from tailgate.base.errors import InputError
from tailgate.board.card import read_card, with_cards

ROOT = Path(__file__).parent.parent
GOOD = {"text": "kf", "name": "Kalman filter", "licence": "MIT", "threat_model": "None.", "training": "none", "uses": ["measurements"]}


def written(folder: Path, file: str = "a.json", /, **changes: object) -> Path:
    """A card with changes."""
    path = folder / file
    path.write_text(json.dumps(GOOD | changes))
    return path


def test_the_template_in_the_documentation_is_a_card(tmp_path: Path) -> None:
    """The JSON of docs/governance.md reads as it stands, but for its link that is none."""
    text = re.search(r"```json\n(.*?)```", (ROOT / "docs/governance.md").read_text(), re.DOTALL)
    assert text is not None
    path = tmp_path / "card.json"
    path.write_text(text[1])
    assert read_card(path).text == "saturated"


def test_a_board_shows_what_the_cards_say(tmp_path: Path) -> None:
    """Of the entry that the card names, beside what is registered; an empty field says nothing; attacks have cards too."""
    written(tmp_path, code="https://example.org/kf")
    written(tmp_path, "b.json", kind="attack", text="fdi", uses=[])
    board = {"entries": [{"defence": "kf", "card": {"reference": "Kalman 1960"}}, {"defence": "rkf", "card": None}], "attacks": [{"attack": "fdi"}]}
    told = with_cards(board, tmp_path)
    assert told["entries"][0]["card"]["code"] == "https://example.org/kf" and told["entries"][0]["card"]["reference"] == "Kalman 1960"
    assert told["entries"][1]["card"] is None and told["attacks"][0]["card"]["licence"] == "MIT"
    assert board["entries"][0]["card"] == {"reference": "Kalman 1960"}  # the board that went in is as it was
    written(tmp_path, "c.json")
    with pytest.raises(InputError, match="no other card"):
        with_cards(board, tmp_path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": " "}, ["name"]), ({"code": "javascript:alert(1)"}, ["code", "https"]), ({"uses": ["truth"]}, ["uses", "truth"]),
        ({"uses": ["lidar"]}, ["uses", "lidar"]), ({"rank": 1}, ["rank"]), ({"kind": "dance"}, ["kind"]), ({"licence": 3}, ["licence"]),
    ],
)  # fmt: skip
def test_a_bad_card_is_one_clear_error(tmp_path: Path, changes: dict[str, object], words: list[str]) -> None:
    """The file and the field."""
    with pytest.raises(InputError) as error:
        read_card(written(tmp_path, **changes))
    assert all(word in str(error.value) for word in ["a.json", *words]), str(error.value)


def test_issue_forms_are_forms() -> None:
    """Each has a name, and fields with labels; required ones say so."""
    for path in sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml")):
        form = yaml.safe_load(path.read_text())
        assert form["name"] and form["description"] and any(part.get("validations", {}).get("required") for part in form["body"])
        assert all(part["attributes"].get("label") or part["type"] == "markdown" for part in form["body"])


def test_the_form_for_a_defence_names_every_board() -> None:
    text = (ROOT / ".github/ISSUE_TEMPLATE/defence.yml").read_text()
    boards = {path.parent.name for path in (ROOT / "results").glob("*/board.json*")}
    assert len(boards) > 9 and {name for name in boards if name not in text} == set()
