"""Damaged files into every reader: each must be read or refused with a sentence; anything else is a crash.

    python -m benchmarks.fuzz_inputs --cases 100000

Every case is a sound file of its kind with one to four mutations (bytes, lines, cells and numbers exchanged, repeated,
cut, or replaced by hostile ones), from a seed, so that a crash can be repeated by its number.
"""

import argparse
import random
import re
import resource
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

from benchmarks.fuzz_files import READERS
from robcal.errors import RobcalError

HOSTILE = (
    *(
        "nan",
        "-inf",
        "1e999",
        "1e308",
        "9" * 400,
        "-0",
        "",
        "null",
        "true",
        "'",
        '"',
        "\x00",
        "\ufeff",
        "\u202e",
        "é",
        "💥",
    ),
    *(
        "../../etc/passwd",
        "<script>",
        "[",
        "{",
        "&a [*a, *a]",
        "*a",
        "!!python/object:os.system",
        "<<: *a",
        "---",
        "#",
        ";",
    ),
    *(
        ",,,,",
        "\t",
        "\r",
        "A" * 5000,
        "%s%n",
        "1,5",
        "0x10",
        "1_000",
        "CON",
        "<!DOCTYPE a [<!ENTITY b 'c'>]>",
        "<",
        ">",
        "/>",
    ),
)
SLOW = 5.0
"""Seconds of processor time above which a single case counts as hanging."""


def with_one_number_changed(raw: bytes, rng: random.Random) -> bytes:
    """What passes the form and has to be judged by its meaning."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?", raw))
    if not found:
        return raw
    at = rng.choice(found)
    other = rng.choice((b"0", b"-1", b"1e-9", b"1e9", b"1e30", b"-1e300", b"90", b"180", b"2", rng.choice(found)[0]))
    return raw[: at.start()] + other + raw[at.end() :]


def mutated(raw: bytes, rng: random.Random) -> bytes:
    """A file with one to four things wrong, every other time numbers alone."""
    if rng.random() < 0.5:
        for _ in range(rng.randint(1, 3)):
            raw = with_one_number_changed(raw, rng)
        return raw
    for _ in range(rng.randint(1, 4)):
        kind, n = rng.randrange(7), max(len(raw), 1)
        i, j = sorted((rng.randrange(n), rng.randrange(n)))
        word = rng.choice(HOSTILE).encode("utf-8", "surrogatepass")
        if kind == 0:
            raw = raw[:i] + bytes([rng.randrange(256)]) + raw[i + 1 :]
        elif kind == 1:
            raw = raw[:i] + word + raw[i:]
        elif kind == 2:
            raw = raw[:i] + raw[min(j, i + 40) :]
        elif kind == 3:
            raw = raw[:j] + raw[i:j] * rng.choice((1, 1, 2, 30)) + raw[j:]
        elif kind == 4:
            raw = raw[:i]
        elif kind == 5:
            lines = raw.split(b"\n")
            rng.shuffle(lines)
            raw = b"\n".join(lines)
        else:  # a whole token gives way to a hostile one
            cells = raw.replace(b",", b"\n,\n").replace(b" ", b"\n \n").split(b"\n")
            at = rng.randrange(len(cells))
            raw = raw.replace(cells[at], word, 1) if cells[at] else raw
        raw = raw[:200_000]
    return raw


def one_case(number: int, folder: Path) -> tuple[str, str]:
    """Kind of the file, and 'read', 'refused', or what went wrong."""
    rng = random.Random(number)
    kind = list(READERS)[number % len(READERS)]
    suffix, sound, read = READERS[kind]
    path = folder / f"case{suffix}"
    path.write_bytes(mutated(sound, rng))
    begin = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # overflow, division by zero: what follows is no number
            read(path)
        outcome = "read"
    except RobcalError as error:
        outcome = "refused" if str(error).strip() else "refused without a word"
    except Exception as error:
        outcome = f"crashed: {type(error).__name__}: {error}"[:160]
    slow = time.process_time() - begin > SLOW
    return kind, f"took more than {SLOW:g} s" if slow else outcome


def run_cases(first: int, cases: int) -> tuple[Counter[tuple[str, str]], dict[str, int]]:
    """Outcomes counted by kind; by outcome that is none of the wanted ones the number of its first case."""
    counts: Counter[tuple[str, str]] = Counter()
    examples: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, first + cases):
            kind, outcome = one_case(number, Path(folder))
            counts[kind, outcome if outcome in ("read", "refused") else "crashed"] += 1
            if outcome not in ("read", "refused"):
                examples.setdefault(f"{kind}: {outcome}", number)
    return counts, examples


def main() -> None:
    """Print a table of outcomes."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first case: it is its seed")
    chosen = parser.parse_args()
    begin = time.perf_counter()
    counts, examples = run_cases(chosen.first, chosen.cases)
    print("| file | read | refused in a sentence | crashed or hung |\n|---|---|---|---|")
    for kind in READERS:
        print(f"| {kind} | " + " | ".join(str(counts[kind, o]) for o in ("read", "refused", "crashed")) + " |")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\n{sum(counts.values())} cases in {time.perf_counter() - begin:.0f} s, at most {memory:.0f} MB")
    for what, number in examples.items():
        print(f"case {number}: {what}")
    raise SystemExit(1 if examples else 0)


if __name__ == "__main__":
    main()
