"""Ids, reading at any tilt and turn, and never a wrong code."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robcal.errors import InvalidInput
from robcal.imaging.detect import detect_targets
from robcal.imaging.detections import CodeState
from robcal.imaging.ring_code import canonical_id, is_id
from robcal.imaging.settings import DetectionSettings
from tests.imaging.rendering import Dot, expose, render

IDS = [k for k in range(1, 4095) if is_id(k) and 4 <= k.bit_count() <= 8]


@given(st.integers(0, 4095), st.integers(0, 11))
def test_id_is_the_same_for_all_turns(bits: int, turn: int) -> None:
    turned = ((bits << turn) | (bits >> (12 - turn))) & 4095
    assert canonical_id(turned) == canonical_id(bits) <= bits


def test_examples_of_the_contract() -> None:
    assert canonical_id(302) == 151
    assert is_id(151)
    assert not is_id(302)
    with pytest.raises(InvalidInput):
        canonical_id(4096)


def grid(rng: np.random.Generator, size: float, tilt: float, count: int = 16) -> list[Dot]:
    pitch = 6.8 * size + 6
    ids = rng.choice(IDS, count, replace=False)
    side = int(np.ceil(np.sqrt(count)))
    return [
        Dot(
            pitch * (k % side + 0.6) + rng.uniform(-0.5, 0.5),
            pitch * (k // side + 0.6) + rng.uniform(-0.5, 0.5),
            size,
            size * tilt,
            rng.uniform(0, np.pi),
            int(ids[k]),
            rng.uniform(0, 2 * np.pi),
        )
        for k in range(count)
    ]


def readings(image: np.ndarray, dots: list[Dot], **more) -> tuple[int, int]:
    """How many codes are right, and how many are wrong."""
    found = detect_targets(image, DetectionSettings(**more))
    right = wrong = 0
    for xy, code in zip(found.xy, found.code, strict=True):
        if code < 0:
            continue
        near = [d for d in dots if np.hypot(d.x - xy[0], d.y - xy[1]) < 0.5 * d.b]
        if near and near[0].bits == code:
            right += 1
        else:
            wrong += 1
    return right, wrong


@pytest.mark.parametrize(("size", "tilt"), [(4.0, 1.0), (5.0, 0.6), (8.0, 0.45), (12.0, 0.8)])
def test_reads_all_codes(size: float, tilt: float) -> None:
    rng = np.random.default_rng(int(10 * size))
    dots = grid(rng, size, tilt)
    extent = int((6.8 * size + 6) * 4.4)
    image = expose(render(extent, extent, dots), rng)
    assert readings(image, dots) == (16, 0)


def test_reading_is_clockwise_as_seen() -> None:
    # one lit run of 1, then 2, then 3 segments at growing image angle (y down: clockwise as seen)
    bits = 0b100_110_011_100
    mirrored = int(format(bits, "012b")[::-1], 2)
    assert canonical_id(bits) != canonical_id(mirrored)
    image = expose(render(120, 120, [Dot(60, 60, 8, 8, 0.0, bits, 0.0)]), np.random.default_rng(1))
    assert detect_targets(image).code.max() == canonical_id(bits)


def test_covered_rings_give_no_wrong_code() -> None:
    # an object of another grey value in front of a part of the target; known codes only
    rng = np.random.default_rng(4)
    known = frozenset(int(k) for k in rng.choice(IDS, 25, replace=False))
    wrong = right = 0
    for trial in range(6):
        dots = [Dot(d.x, d.y, d.a, d.b, d.angle, sorted(known)[k], d.phase) for k, d in enumerate(grid(rng, 7.0, 0.8))]
        light = render(236, 236, dots, sub=4)
        for dot in dots:
            direction, offset = rng.uniform(0, 2 * np.pi), rng.uniform(0.0, 2.8) * dot.b
            y, x = np.indices(light.shape)
            along = (x - dot.x) * np.cos(direction) + (y - dot.y) * np.sin(direction)
            near = np.hypot(x - dot.x, y - dot.y) < 3.3 * dot.a
            light[near & (along > offset)] = (0.05, 0.15, 0.0)[trial % 3]
        found = readings(expose(light, rng), dots, known_codes=known)
        right, wrong = right + found[0], wrong + found[1]
    assert wrong == 0


def test_codes_that_are_not_on_the_body_are_none() -> None:
    rng = np.random.default_rng(5)
    dots = grid(rng, 7.0, 0.9, 4)
    image = expose(render(130, 130, dots), rng)
    known = frozenset({dots[0].bits, dots[2].bits})
    found = detect_targets(image, DetectionSettings(known_codes=known))
    assert set(found.code[found.code >= 0]) == known
    assert (found.code_state == CodeState.UNREADABLE).sum() == 2


def test_dots_side_by_side_are_no_code() -> None:
    # a hexagon of dots around a dot at the distance of a ring: all are dots
    rng = np.random.default_rng(6)
    r = 6.0
    dots = [Dot(60, 60, r, r)] + [
        Dot(60 + 3.2 * r * np.cos(k * np.pi / 3), 60 + 3.2 * r * np.sin(k * np.pi / 3), r, r) for k in range(6)
    ]
    found = detect_targets(expose(render(120, 120, dots), rng))
    assert len(found) == 7
    assert (found.code < 0).all()
