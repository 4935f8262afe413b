"""Images that are broken, strange, or do not belong where they lie: one sentence with the file and the remedy."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.runner import run_campaign
from robcal.errors import RobcalError
from robcal.files.images import read_image
from tests.pipeline.conftest import edit_rows, edit_yaml


def refused(campaign: Path, out: Path, until: str = "orient") -> str:
    """The sentence with which the command refuses a campaign."""
    done = CliRunner().invoke(app, ["run", str(campaign), "--out", str(out), "--until", until, "--workers", "1", "-q"])
    assert done.exit_code == 1
    (text,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert "internal error" not in text
    assert "Traceback" not in done.output
    return text


def first(folder: Path, number: int = 0) -> Path:
    return sorted(p for p in folder.iterdir() if p.is_file())[number]


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif"])
def test_truncated_and_corrupt_files_of_every_kind(tmp_path: Path, suffix: str) -> None:
    image = np.random.default_rng(1).integers(0, 255, (240, 320), dtype=np.uint8)
    path = tmp_path / f"image{suffix}"
    cv2.imwrite(str(path), image)
    if suffix != ".jpg":
        np.testing.assert_array_equal(read_image(path), image)
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) // 2])
    with pytest.raises(RobcalError, match=f"image{suffix}.*(truncated|corrupt)"):
        read_image(path)
    path.write_bytes(b"something else entirely")
    with pytest.raises(RobcalError, match=f"image{suffix}.*(is not|corrupt)"):
        read_image(path)
    path.write_bytes(b"")
    with pytest.raises(RobcalError, match="empty image file"):
        read_image(path)


def test_sixteen_bit_and_colour(tmp_path: Path) -> None:
    deep = np.random.default_rng(1).integers(0, 65535, (24, 32), dtype=np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), deep)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), deep)
    colour = np.zeros((24, 32, 3), np.uint8)
    colour[..., 1] = 200
    cv2.imwrite(str(tmp_path / "b.png"), colour)
    assert read_image(tmp_path / "b.png").shape == (24, 32)


def test_an_image_header_that_promises_too_much(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    cv2.imwrite(str(path), np.zeros((8, 8), np.uint8))
    raw = bytearray(path.read_bytes())
    raw[16:24] = (200_000).to_bytes(4, "big") * 2
    path.write_bytes(bytes(raw))
    with pytest.raises(RobcalError, match=r"bomb\.png.*pixels"):
        read_image(path)


def test_truncated_image_in_a_campaign(image_campaign: Path, detected: Path) -> None:
    path = first(image_campaign / "station" / "left")
    path.write_bytes(path.read_bytes()[:5000])
    told = refused(image_campaign, detected)
    assert str(path) in told
    assert "copy it again or remove it" in told


def test_wrong_size_among_images(image_campaign: Path, detected: Path) -> None:
    path = first(image_campaign / "survey" / "plate", 2)
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), (320, 256)))
    told = refused(image_campaign, detected)
    assert str(path) in told
    assert "320 x 256" in told
    assert "640 x 512" in told


def test_the_same_image_twice(image_campaign: Path, detected: Path) -> None:
    folder = image_campaign / "station" / "left"
    shutil.copy(first(folder), first(folder, 1))
    told = refused(image_campaign, detected)
    assert "byte for byte the same image" in told
    assert first(folder, 1).name in told


def test_one_black_image_is_left_out_and_told(image_campaign: Path, detected: Path) -> None:
    path = first(image_campaign / "station" / "left", 1)
    cv2.imwrite(str(path), np.zeros((512, 640), np.uint8))
    done = run_campaign(image_campaign, detected, until="detect", workers=1)
    assert any(str(path) in note and "left out" in note for note in done.result["notes"])


def test_images_of_something_else(image_campaign: Path, tmp_path: Path) -> None:
    shutil.rmtree(image_campaign / "survey")
    edit_yaml(image_campaign / "campaign.yaml", lambda d: d["bodies"]["plate"].pop("survey"))
    rng = np.random.default_rng(2)
    for folder in ("left", "right"):
        for number, path in enumerate(sorted((image_campaign / "station" / folder).iterdir())):
            if number > 1:
                path.unlink()
                continue
            noise = cv2.GaussianBlur(rng.integers(0, 255, (512, 640), dtype=np.uint8), (0, 0), 12)
            cv2.imwrite(str(path), noise)
    told = refused(image_campaign, tmp_path / "run")
    assert "station" in told
    assert "left" in told


def test_all_images_black(image_campaign: Path, detected: Path) -> None:
    for number, path in enumerate(sorted((image_campaign / "station" / "right").iterdir())):
        black = np.zeros((512, 640), np.uint8)
        black[0, number] = 1  # otherwise they would be copies of one another
        cv2.imwrite(str(path), black)
    told = refused(image_campaign, detected, until="detect")
    assert "no targets found in any of 15 images" in told
    assert "right" in told


def test_images_slipped_by_one_against_the_joint_log(image_campaign: Path, detected: Path) -> None:
    for camera in ("left", "right"):
        folder = image_campaign / "station" / camera
        paths = sorted(folder.iterdir())
        contents = [p.read_bytes() for p in paths]
        for path, content in zip(paths[1:], contents[:-1], strict=True):
            path.write_bytes(content)
        paths[0].unlink()
    told = refused(image_campaign, detected, until="identify")
    assert "do not belong together" in told
    assert "slipped" in told


def test_body_of_fewer_than_three_targets(image_campaign: Path, detected: Path) -> None:
    edit_yaml(image_campaign / "campaign.yaml", lambda d: d["bodies"]["plate"].pop("survey"))
    edit_yaml(image_campaign / "plate.yaml", lambda d: d.update(targets=d["targets"][:2]))
    told = refused(image_campaign, detected)
    assert "2 targets with coordinates" in told
    assert "plate.yaml" in told


def collinear(data: dict) -> None:
    for k, target in enumerate(data["targets"]):
        target["xyz_mm"] = [20.0 * k, 10.0 * k, 0.0]


def test_all_targets_in_one_line(point_campaign: Path, tmp_path: Path) -> None:
    edit_yaml(point_campaign / "plate.yaml", collinear)
    told = refused(point_campaign, tmp_path / "run", until="frames")
    assert "one line" in told


def test_body_with_one_camera_only_is_resected_and_said_to_be(image_campaign: Path, detected: Path) -> None:
    edit_yaml(image_campaign / "campaign.yaml", lambda d: d["bodies"]["plate"].pop("survey"))
    edit_yaml(image_campaign / "campaign.yaml", lambda d: d["station"]["cameras"].pop("right"))
    done = run_campaign(image_campaign, detected, until="frames", workers=1)
    assert any("resection from one camera" in note for note in done.result["notes"])


def test_plane_body_with_one_camera_only(image_campaign: Path, detected: Path) -> None:
    def flat(data: dict) -> None:
        for target in data["targets"]:
            if target["xyz_mm"] is not None:
                target["xyz_mm"][2] = 0.0

    edit_yaml(image_campaign / "campaign.yaml", lambda d: d["bodies"]["plate"].pop("survey"))
    edit_yaml(image_campaign / "campaign.yaml", lambda d: d["station"]["cameras"].pop("right"))
    edit_yaml(image_campaign / "plate.yaml", flat)
    try:
        done = run_campaign(image_campaign, detected, until="frames", workers=1)
    except RobcalError as error:
        told = str(error)
    else:
        told = " ".join(done.result["notes"])
    assert "internal" not in told
    assert "two" in told or "resection" in told or "ambiguous" in told


def test_contradictory_scale_bars(image_campaign: Path, detected: Path) -> None:
    def twice(data: dict) -> None:
        bars = data["bodies"]["plate"]["survey"]["scale_bars"]
        bars.append({**bars[0], "length_mm": bars[0]["length_mm"] + 3.0})

    edit_yaml(image_campaign / "campaign.yaml", twice)
    told = refused(image_campaign, detected, until="survey")
    assert "scale bar" in told
    assert "keep the right one" in told


def test_nothing_measured_of_the_robot(point_campaign: Path, tmp_path: Path) -> None:
    edit_rows(point_campaign / "poses.csv", lambda rows: [{**r, "set": "verify"} for r in rows])
    told = refused(point_campaign, tmp_path / "run", until="identify")
    assert "no measured pose is left to identify from" in told
