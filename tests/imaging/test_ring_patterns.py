"""Ring codes of 8 to 20 segments with other radii and the other direction; body files that state them."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from robcal.errors import InvalidInput
from robcal.files.body_file import body_from_file, check_ring_codes, read_body, write_body
from robcal.imaging.detect import detect_targets
from robcal.imaging.ring_code import RingPattern, canonical_id, ring_segments
from robcal.imaging.settings import DetectionSettings
from robcal.recipe.detection import detection_settings

pytestmark = pytest.mark.unit
_SUB = 6


def _drawn(pattern: RingPattern, ids: list[int], radius: float, seed: int) -> NDArray[np.uint8]:
    """Bright targets on dark in a row, tilted, turned, with blur and noise."""
    rng = np.random.default_rng(seed)
    pitch = int(2.6 * pattern.outer * radius + 16)
    fine = (np.arange(pitch * _SUB) + 0.5) / _SUB - 0.5
    cells = []
    for number in ids:
        x, y = np.meshgrid(fine - pitch / 2 - rng.uniform(-0.5, 0.5), fine - pitch / 2 - rng.uniform(-0.5, 0.5))
        u, v = x / radius, y / (0.85 * radius)
        rho, angle = np.hypot(u, v), np.arctan2(v, u) + rng.uniform(0, 2 * np.pi)
        # angles grow clockwise as y is down
        place = np.floor((angle if pattern.clockwise else -angle) / pattern.step).astype(int) % pattern.segments
        bits = (number >> (pattern.segments - 1 - place)) & 1
        shape = np.where((rho > pattern.inner) & (rho < pattern.outer), bits, (rho < 1).astype(int)).astype(float)
        cells.append(gaussian_filter(shape, 0.7 * _SUB).reshape(pitch, _SUB, pitch, _SUB).mean(axis=(1, 3)))
    grey = 15 + 170 * np.hstack(cells)
    return np.clip(np.rint(grey + rng.normal(size=grey.shape)), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("pattern", "radius"),
    [
        (RingPattern(8), 5.0),
        (RingPattern(10, 1.6, 2.4), 7.0),
        (RingPattern(14, 2.0, 3.0, clockwise=False), 7.0),
        (RingPattern(14, 2.5, 4.0), 6.0),
        (RingPattern(20, 2.0, 3.2), 10.0),
    ],
)
def test_codes_of_other_patterns_are_read(pattern: RingPattern, radius: float) -> None:
    rng = np.random.default_rng(7)
    drawn: list[int] = []
    while len(drawn) < 8:
        number = canonical_id(int(rng.integers(1, 1 << pattern.segments)), pattern.segments)
        if 3 <= number.bit_count() <= pattern.segments - 2 and number not in drawn:
            drawn.append(number)
    image = _drawn(pattern, drawn, radius, seed=3)
    found = detect_targets(image, DetectionSettings(ring=pattern))
    read = found.code[found.code >= 0]
    assert set(read.tolist()) == set(drawn)
    order = np.argsort(found.xy[found.code >= 0, 0])
    assert read[order].tolist() == drawn


def test_direction_matters_for_codes_that_are_no_mirror_images() -> None:
    number = 0b000000010011
    image = _drawn(RingPattern(12), [number], 7.0, seed=4)
    turned = detect_targets(image, DetectionSettings(ring=RingPattern(12, clockwise=False)))
    assert turned.code.max() == canonical_id(int(f"{number:012b}"[::-1], 2))


def _body(folder: Path, text: str) -> Path:
    path = folder / "b.yaml"
    path.write_text(f"format: robcal/body-1\n{text}")
    return path


def test_a_body_file_states_its_ring_codes(tmp_path: Path) -> None:
    ring = "ring: {inner: 1.6, outer: 2.5, direction: counterclockwise}\n"
    text = f"{ring}targets: [{{id: 7, code: ring14, xyz_mm: [1, 2, 3]}}]\n"
    file = read_body(_body(tmp_path, text))
    check_ring_codes(file)
    settings = detection_settings(file, None)
    assert settings.ring == RingPattern(14, 1.6, 2.5, clockwise=False)
    assert settings.known_codes == frozenset({7})
    write_body(tmp_path / "again.yaml", body_from_file("b", file), ring=file.ring)
    assert read_body(tmp_path / "again.yaml").ring == file.ring
    assert ring_segments("ring14") == 14
    assert ring_segments("aruco:4X4_50") is None


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("targets: [{id: 7, code: ring7}]", "ring8 to ring20"),
        ("targets: [{id: 14, code: ring14}]", "is no ring14 id.*here 7"),
        ("targets: [{id: 300, code: ring8}]", "give 0 to 255"),
        ("targets: [{id: 7, code: ring8}, {id: 11, code: ring12}]", "several kinds"),
        ("ring: {inner: 3, outer: 2}\ntargets: [{id: 7, code: ring14}]", "inner < outer"),
        ("ring: {direction: left}\ntargets: [{id: 7, code: ring14}]", "'clockwise' or 'counterclockwise'"),
    ],
)
def test_impossible_ring_codes_are_told(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(InvalidInput, match=told):
        check_ring_codes(read_body(_body(tmp_path, text + "\n")))
