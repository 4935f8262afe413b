"""The page of faults names tests that exist; damaged files are read or refused."""

import re
from pathlib import Path

from benchmarks.fuzz_inputs import READERS, run_cases

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "faults.md").read_text(encoding="utf-8")


def test_every_fault_is_held_by_a_test_that_exists() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("| ") and "::" in line]
    assert len(rows) > 20
    for row in rows:
        named = re.search(r"`(test_\w+\.py)::(test_\w+)` \|$", row)
        assert named is not None, row
        source = (ROOT / "tests" / "pipeline" / named[1]).read_text(encoding="utf-8")
        assert f"def {named[2]}(" in source, row


def test_damaged_files_are_read_or_refused() -> None:
    counts, examples = run_cases(first=0, cases=20 * len(READERS))
    assert not examples
    assert sum(counts.values()) == 20 * len(READERS)
    assert sum(n for (_, outcome), n in counts.items() if outcome == "refused") > 5 * len(READERS)
