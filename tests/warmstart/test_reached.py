"""The table of what jumps, hurdles and lunges were asked for and reached."""

import json
from pathlib import Path

import pytest

from warmstart.bank import demonstration_files
from warmstart.reached import OUTCOME, main, reached, table

PAGE = Path(__file__).parents[2] / "docs" / "reached.md"


def test_the_page_is_what_the_command_writes_now(tmp_path):
    assert main(["--out", str(tmp_path / "page.md")]) == 0
    assert (tmp_path / "page.md").read_text() == PAGE.read_text() == table()


def test_every_clip_has_one_row_with_the_figures_of_its_certificate():
    rows = [line for line in table().splitlines() if line.startswith("| ")][1:]
    files = [path for name in OUTCOME for path in demonstration_files(name)]
    rows = [row for row in rows if not row.startswith("| ---")]
    assert [row.split(" | ")[0].removeprefix("| ") for row in rows] == [p.stem for p in files]
    for row, path in zip(rows, files, strict=True):
        proof = json.loads(path.with_suffix(".json").read_text())
        asked, planned, _, drake = (float(cell) for cell in row.split(" | ")[1:5])
        assert asked == pytest.approx(proof["asked"][OUTCOME[proof["problem"]]], abs=5e-4)
        assert planned == pytest.approx(proof["achieved"]["planned"], abs=5e-4)
        assert drake == pytest.approx(proof["achieved"]["replay_drake"], abs=5e-4)


@pytest.mark.parametrize("problem", OUTCOME)
def test_all_reach_what_they_were_asked_for(problem):
    """Bars and hurdles are cleared as they were set, jumps are as long as asked; a lunge is within
    3 cm of its reach."""
    for found in map(reached, demonstration_files(problem)):
        assert found.tracked >= found.asked - (0.03 if problem == "fencing" else 0.0)


def test_a_clip_of_another_problem_is_a_sentence():
    path = demonstration_files("tennis")[0]
    with pytest.raises(ValueError, match=r"is a clip of 'tennis', not of one of: high_jump"):
        reached(path)
