"""Sheets of targets: drawn from the PDF they are where the body file has them; pictures of what images show."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pypdfium2
import pytest
import yaml
from typer.testing import CliRunner

from fixtures.board_scene import render_board
from pipeline.cli import app
from pipeline.sheets.sheets import make_sheet
from robcal.errors import InvalidInput
from robcal.files.body_file import read_body
from robcal.imaging.detect import detect_targets
from robcal.imaging.settings import DetectionSettings
from robcal.photogrammetry.boards.detect import find_board
from tests.photogrammetry.boards.rendered import CAMERA, PATTERNS, looking_at

_DPI = 120.0


def _config(folder: Path, **content: Any) -> Path:
    path = folder / "what.yaml"
    path.write_text(yaml.safe_dump({"format": "robcal/targets-1", **content}))
    return path


def _picture(pdf: Path, page: int = 0) -> np.ndarray:
    """Grey image of a page, 8 bit."""
    with pypdfium2.PdfDocument(pdf) as document:
        drawn = document[page].render(scale=_DPI / 72.0, grayscale=True).to_numpy()
    grey = np.ascontiguousarray(drawn.reshape(drawn.shape[0], drawn.shape[1]))
    return np.clip(cv2.GaussianBlur(grey, (0, 0), 0.8) * 0.8 + 20, 0, 255).astype(np.uint8)


def _fits(pdf: Path, xy: np.ndarray, places: np.ndarray) -> float:
    """Largest distance in mm of drawn marks from places in mm, moved but neither turned nor scaled."""
    with pypdfium2.PdfDocument(pdf) as document:
        page = np.array(document[0].get_size())
        drawn = document[0].render(scale=_DPI / 72.0)  # the page fills a whole number of pixels
    drawn = xy * (page * 25.4 / 72.0 / (drawn.width, drawn.height))
    away = drawn - places
    return float(np.abs(away - away.mean(axis=0)).max())


@pytest.mark.parametrize(
    "board",
    [
        {"kind": "charuco", "columns": 7, "rows": 5, "square_mm": 26, "marker_mm": 19, "dictionary": "DICT_4X4_50"},
        {"kind": "chessboard", "columns": 8, "rows": 5, "square_mm": 20},
        {"kind": "aprilgrid", "columns": 4, "rows": 3, "marker_mm": 40, "spacing_mm": 12},
        {"kind": "circles", "columns": 7, "rows": 6, "spacing_mm": 24, "diameter_mm": 14},
        {"kind": "asymmetric_circles", "columns": 4, "rows": 11, "spacing_mm": 18, "diameter_mm": 14},
    ],
    ids=lambda board: board["kind"],
)
def test_a_printed_board_is_to_scale_and_found(tmp_path: Path, board: dict[str, Any]) -> None:
    done = make_sheet(_config(tmp_path, board=board), tmp_path / "sheet.pdf")
    body = read_body(Path(done["body"]))
    assert body.board is not None
    found = find_board(_picture(tmp_path / "sheet.pdf"), body.board)
    assert len(found) == len(body.targets)
    assert _fits(tmp_path / "sheet.pdf", found.xy, 1000 * body.board.points()[found.code, :2]) < 0.03


@pytest.mark.parametrize("ground", ["dark", "bright"])
def test_a_printed_plate_is_read(tmp_path: Path, ground: str) -> None:
    config = _config(
        tmp_path,
        targets={"diameter_mm": 7, "count": 12, "plain": 8, "ground": ground},
        layout={"kind": "plate", "columns": 5, "rows": 4, "pitch_mm": 34},
    )
    done = make_sheet(config, tmp_path / "plate.pdf")
    body = read_body(Path(done["body"]))
    ids = {t.id: t.xyz for t in body.targets if t.code == "ring12" and t.xyz is not None}
    polarity = "bright" if ground == "dark" else "dark"
    found = detect_targets(_picture(tmp_path / "plate.pdf"), DetectionSettings(polarity=polarity))  # type: ignore[arg-type]
    rows = np.flatnonzero(found.code >= 0)
    assert set(found.code[rows].tolist()) == set(ids)
    places = 1000 * np.array([ids[code] for code in found.code[rows].tolist()])[:, :2]
    assert _fits(tmp_path / "plate.pdf", found.xy[rows], places) < 0.03


def test_targets_to_cut_out_for_a_sphere(tmp_path: Path) -> None:
    config = _config(
        tmp_path,
        targets={"diameter_mm": 12, "ids": [151, 343, 87], "plain": 40},
        layout={"kind": "sphere", "radius_mm": 200},
    )
    body = read_body(Path(make_sheet(config, tmp_path / "s.pdf")["body"]))
    radii = [np.linalg.norm(t.xyz) for t in body.targets if t.xyz is not None]
    np.testing.assert_allclose(radii, 0.2, atol=1e-8)
    assert [t.id for t in body.targets if t.code].count(151) == 1
    assert len(body.targets) == 43
    with pypdfium2.PdfDocument(tmp_path / "s.pdf") as document:
        assert len(document) > 1


def test_the_same_description_gives_the_same_bytes(tmp_path: Path) -> None:
    config = _config(tmp_path, targets={"diameter_mm": 10, "count": 5})
    make_sheet(config, tmp_path / "a.pdf")
    first = (tmp_path / "a.pdf").read_bytes()
    make_sheet(config, tmp_path / "a.pdf")
    assert (tmp_path / "a.pdf").read_bytes() == first


_CHESS = {"kind": "chessboard", "columns": 9, "rows": 6, "square_mm": 40}
_DOTS = {"diameter_mm": 10, "count": 4}


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({}, "either 'board' or 'targets'"),
        ({"board": _CHESS}, "choose a larger 'page'"),
        ({"board": {**_CHESS, "columns": 1}}, "3 to 500"),
        ({"board": _CHESS, "page": "A9"}, "one of A0"),
        ({"board": _CHESS, "page": [10, 10]}, "60 to 2500"),
        ({"targets": {"diameter_mm": 10, "ids": [302]}}, "151"),
        ({"targets": {"diameter_mm": 10, "ids": [151, 151]}}, "twice"),
        ({"targets": {"diameter_mm": 10, "count": 0}}, "no targets"),
        ({"targets": {"diameter_mm": 90}}, "choose a larger 'page'"),
        ({"targets": _DOTS, "layout": {"kind": "plate", "columns": 3, "rows": 3, "pitch_mm": 60}}, "add up to 9"),
        ({"targets": _DOTS, "layout": {"kind": "plate", "columns": 2, "rows": 2, "pitch_mm": 20}}, "pitch_mm"),
    ],
)
def test_impossible_sheets_are_told_in_one_sentence(tmp_path: Path, content: dict[str, Any], told: str) -> None:
    with pytest.raises(InvalidInput, match=told) as error:
        make_sheet(_config(tmp_path, **content), tmp_path / "sheet.pdf")
    assert "what.yaml" in str(error.value)
    assert not (tmp_path / "sheet.pdf").exists()


def test_images_are_shown_with_what_was_read(tmp_path: Path) -> None:
    config = _config(
        tmp_path,
        targets={"diameter_mm": 7, "count": 12, "plain": 8},
        layout={"kind": "plate", "columns": 5, "rows": 4, "pitch_mm": 34},
    )
    make_sheet(config, tmp_path / "plate.pdf")
    (tmp_path / "images").mkdir()
    for k in range(2):
        cv2.imwrite(str(tmp_path / "images" / f"im{k}.png"), _picture(tmp_path / "plate.pdf"))
    arguments = ["targets", "--images", str(tmp_path / "images"), "--out", str(tmp_path / "seen"), "--json", "-q"]
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code == 0, answer.output
    told = json.loads(answer.stdout.splitlines()[-1])
    assert all(len(row["codes"]) == 12 for row in told["images"])
    draft = read_body(tmp_path / "seen" / "body.yaml")
    assert sum(t.code == "ring12" for t in draft.targets) == 12
    picture = cv2.imread(str(tmp_path / "seen" / "im0.jpg"))
    assert picture is not None
    blue, green, red = (picture[..., k].astype(int) for k in range(3))
    assert ((green - red > 60) & (green - blue > 60)).sum() > 200


def test_images_of_a_board_and_of_nothing(tmp_path: Path) -> None:
    pattern = PATTERNS["charuco"]
    (tmp_path / "images").mkdir()
    image = render_board(pattern, CAMERA, looking_at(pattern, 0.5, (10.0, 5.0, 3.0)), seed=1).image
    cv2.imwrite(str(tmp_path / "images" / "a.png"), image)
    body = tmp_path / "board.yaml"
    board = {"kind": "charuco", "columns": 6, "rows": 5, "square_mm": 30, "marker_mm": 22, "dictionary": "4X4_250"}
    body.write_text(yaml.safe_dump({"format": "robcal/body-1", "board": board}))
    arguments = ["targets", "--images", str(tmp_path / "images"), "--out", str(tmp_path / "seen"), "--body", str(body)]
    answer = CliRunner().invoke(app, [*arguments, "--json", "-q"])
    told = json.loads(answer.stdout.splitlines()[-1])
    assert len(told["images"][0]["codes"]) == 20
    assert told["never_seen"] == []
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.full((80, 80), 127, np.uint8))
    nothing = CliRunner().invoke(app, [*arguments[:5], "-q"])
    assert nothing.exit_code == 1
    assert CliRunner().invoke(app, ["targets", "--out", "x.pdf"]).exit_code == 2
