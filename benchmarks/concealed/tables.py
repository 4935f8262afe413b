"""Tables for the documentation from stored records."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

Record = dict[str, Any]


def _share(values: Iterable[Any]) -> str:
    given = [bool(v) for v in values if v is not None]
    if not given:
        return "–"
    return f"{100 * np.mean(given):.1f} % ({sum(given)}/{len(given)})"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _groups(records: Sequence[Record], key: Callable[[Record], Any]) -> list[tuple[Any, list[Record]]]:
    names = sorted({key(r) for r in records}, key=lambda v: (str(type(v)), v))
    return [(name, [r for r in records if key(r) == name]) for name in names]


def gain_share(record: Record, region: str) -> float | None:
    """Share of what the true form gains on kept-out poses; None where that is less than a tenth of the error."""
    before, after, best = (record.get(f"{k}_{region}") for k in ("before", "after", "oracle"))
    if before is None or after is None or best is None or before - best < 0.1 * before:
        return None
    return float((before - after) / (before - best))


def _gains(records: Sequence[Record], region: str) -> str:
    shares = [g for g in (gain_share(r, region) for r in records) if g is not None]
    if not shares:
        return "–"
    return f"{np.median(shares):.2f} / {np.percentile(shares, 10):.2f} ({len(shares)})"


def _common(records: Sequence[Record]) -> list[str]:
    found = [r for r in records if r["mismatch"]]
    sizes = [r["set_size"] for r in found if "set_size" in r]
    inside, total = (sum(r.get(k, 0) for r in found) for k in ("intervals_inside", "intervals"))
    return [
        str(len(records)),
        _share(r["mismatch"] for r in records),
        _share(r.get("stage_right") for r in found),
        _share(r.get("where_right") for r in found),
        _share(r.get("direction_right") for r in found),
        _share(r.get("name_right") for r in found),
        _share(r.get("set_covers") for r in found),
        f"{np.mean(sizes):.2f}" if sizes else "–",
        f"{100 * inside / total:.1f} % of {total}" if total else "–",
        _gains(found, "inside"),
        _gains(found, "outside"),
    ]


HEADER = [
    "runs",
    "detected",
    "stage",
    "axis",
    "direction",
    "name",
    "in the set",
    "set size",
    "95 % intervals hold",
    "gain inside: median / 10 %",
    "gain outside: median / 10 %",
]


def nulls(records: Sequence[Record]) -> str:
    """False alarms at a nominal level of 1 %."""
    rows = [
        [str(name), str(len(group)), _share(r["mismatch"] for r in group)]
        for name, group in _groups(records, lambda r: r["label"])
    ]
    rows.append(["all", str(len(records)), _share(r["mismatch"] for r in records)])
    return _table(["noise", "runs", "false alarms"], rows)


def singles(records: Sequence[Record]) -> str:
    """By SNR, then by cause."""
    by_snr = _table(["SNR", *HEADER], [[f"{snr:g}", *_common(g)] for snr, g in _groups(records, lambda r: r["snr"])])
    by_cause = _table(["cause", *HEADER], [[name, *_common(g)] for name, g in _groups(records, lambda r: r["label"])])
    return f"{by_snr}\n\n{by_cause}"


def outside(records: Sequence[Record]) -> str:
    """Effects that the library has no name for."""

    def row(group: Sequence[Record]) -> list[str]:
        found = [r for r in group if r["mismatch"]]
        return [
            str(len(group)),
            _share(r["mismatch"] for r in group),
            _share(r.get("wrongly_named") for r in found),
            _share(r.get("where_right") for r in found),
            _gains(found, "inside"),
            _gains(found, "outside"),
        ]

    header = ["runs", "detected", "wrongly named", "place right", "gain inside", "gain outside"]
    rows = [[name, *row(g)] for name, g in _groups(records, lambda r: r["label"])]
    return _table(["effect", *header], [*rows, ["all", *row(records)]])


def mixtures(records: Sequence[Record]) -> str:
    """Two and three causes at once."""
    rows = [
        [
            name,
            str(len(g)),
            _share(r["exact"] for r in g),
            f"{np.mean([r['extras'] for r in g]):.2f}",
            f"{np.mean([r['named'] for r in g]):.2f}",
            _gains(g, "inside"),
        ]
        for name, g in _groups(records, lambda r: r["label"])
    ]
    return _table(["causes", "runs", "exact", "extras a run", "named a run", "gain inside"], rows)


def inseparable(records: Sequence[Record]) -> str:
    """Pairs whose signatures coincide; with the proposed poses: the true name itself, not one of its class."""
    rows = []
    for name, g in _groups(records, lambda r: r["label"]):
        found = [r for r in g if r["mismatch"]]
        rows.append(
            [
                name,
                str(len(g)),
                _share(r["mismatch"] for r in g),
                _share(r.get("told_together") for r in found),
                _share(r.get("name_right") for r in found),
                _share(r.get("followed_right") for r in found),
            ]
        )
    header = ["pair", "runs", "detected", "says so", "name in the class", "true name with the proposed poses"]
    return _table(header, rows)


def decoys(records: Sequence[Record]) -> str:
    """False causes that offer themselves."""
    rows = []
    for name, g in _groups(records, lambda r: r["label"]):
        null = not g[0]["truth"]
        rows.append(
            [
                name,
                str(len(g)),
                _share(r["mismatch"] for r in g),
                "–" if null else _share(r.get("name_right") for r in g if r["mismatch"]),
                "–" if null else _share(r.get("set_covers") for r in g if r["mismatch"]),
            ]
        )
    return _table(["decoy", "runs", "mismatch told", "true name first", "true name in the set"], rows)


TABLES = {
    "nulls": nulls,
    "singles": singles,
    "outside": outside,
    "mixtures": mixtures,
    "inseparable": inseparable,
    "decoys": decoys,
}


def report(records: Sequence[Record]) -> str:
    """All tables of the batteries and levels that there are records of."""
    parts = []
    for (battery, level), group in _groups(records, lambda r: (r["battery"], r["level"])):
        failed = [r for r in group if "error" in r]
        done = [r for r in group if "error" not in r and "skipped" not in r]
        parts.append(f"### {battery}, {level}\n")
        if done:
            seconds = [r["seconds"] for r in done]
            parts.append(TABLES[battery](done))
            parts.append(f"\nReading, identification, diagnosis: median {np.median(seconds):.1f} s, ")
            parts[-1] += f"longest {max(seconds):.1f} s."
        if failed:
            parts.append(f"\n{len(failed)} runs failed; the first: {failed[0]['key']}: {failed[0]['error']}")
        parts.append("")
    return "\n".join(parts)
