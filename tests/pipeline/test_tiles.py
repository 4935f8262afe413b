"""Images taken in tiles behind a grid: into a campaign, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from fixtures.campaigns import write_yaml
from fixtures.reseau import TrueReseau, write_reseau, write_tiles
from pipeline.artifacts import DETECTED
from pipeline.campaign_reader import read_campaign
from pipeline.detected_images import load_detections
from pipeline.runner import run_campaign
from pipeline.stages.detect import STAGE
from pipeline.tiled_images import tile_files
from robcal.errors import InvalidInput
from robcal.files.reseau_file import read_reseau, read_tiles

TRUE = TrueReseau(columns=9, rows=9, tile_px=480)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    here = tmp_path_factory.mktemp("tiled")
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0.7:7.5:9j, 0.7:7.5:9j]
    dots = np.stack([x.ravel(), y.ravel()], axis=1) + rng.uniform(-0.1, 0.1, (81, 2))
    (here / "images").mkdir()
    write_reseau(here, TRUE)
    write_tiles(here / "images", "one", TRUE, dots, 0.06, rng, lost=0.1)
    targets = [{"id": k, "diameter_mm": 5.0, "xyz_mm": None} for k in range(81)]
    write_yaml(here / "plate.yaml", {"format": "robcal/body-1", "targets": targets})
    survey = {"images": "images", "tiles": "reseau.yaml"}
    bodies = {"plate": {"targets": "plate.yaml", "survey": survey}}
    write_yaml(here / "campaign.yaml", {"format": "robcal/campaign-1", "name": "tiled", "bodies": bodies})
    return here, dots


def test_targets_of_the_mosaic_are_each_found_once_where_they_are(
    folder: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    here, dots = folder
    run = run_campaign(here, tmp_path / "run", until="detect").run
    found = load_detections(run, run.load(DETECTED), "survey/plate")["one.csv"]
    assert found.shape == (1000, 1000)
    true = (dots + 1.0) * 100.0
    e = true[:, None] - found.xy
    nearest = np.linalg.norm(e, axis=2).argmin(axis=1)
    off = e[np.arange(len(true)), nearest]
    assert len(found) == len(true)
    assert np.sqrt(np.mean(off**2)) < 0.03
    sigma = np.sqrt(np.trace(found.covariance[nearest], axis1=1, axis2=2) / 2)
    assert 0.4 < np.sqrt(np.mean(off**2)) / np.sqrt(np.mean(sigma**2)) < 1.6


def test_the_stage_depends_on_every_tile_and_on_the_grid(folder: tuple[Path, np.ndarray]) -> None:
    here, _ = folder
    inputs = set(STAGE.inputs(read_campaign(here)))
    assert {here / "images" / "one.csv", here / "reseau.yaml", *tile_files(here / "images" / "one.csv")} <= inputs


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("line_um: 40.0", "line_um: 4.0", "lines of 0.4 px"),
        ("arm_um: 200.0", "arm_um: 600.0", "less than half the pitch"),
        ("pitch_mm", "pich_mm", "did you mean 'pitch_mm'"),
        ("sigma_um: 0.1", "sigma_um: 0.1, crosses: missing.csv", "missing.csv"),
    ],
)
def test_grids_that_cannot_be(folder: tuple[Path, np.ndarray], tmp_path: Path, old: str, new: str, told: str) -> None:
    text = (folder[0] / "reseau.yaml").read_text()
    assert old in text
    (tmp_path / "reseau.yaml").write_text(text.replace(old, new))
    with pytest.raises(InvalidInput) as error:
        read_reseau(tmp_path / "reseau.yaml")
    assert told in str(error.value)


def test_lists_of_tiles_that_cannot_be(folder: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text("file,x_mm,y_mm\nnone.png,1,2\n")
    with pytest.raises(InvalidInput, match=r"row 2: none.png is no image beside this list"):
        read_tiles(tmp_path / "one.csv")
    (tmp_path / "campaign.yaml").write_text(
        (folder[0] / "campaign.yaml").read_text().replace("images: images", "images: .")
    )
    for name in ("plate.yaml", "reseau.yaml"):
        (tmp_path / name).write_bytes((folder[0] / name).read_bytes())
    assert list(read_campaign(tmp_path).bodies["plate"].survey.images) == ["one.csv"]  # type: ignore[union-attr]
    (tmp_path / "one.csv").unlink()
    with pytest.raises(InvalidInput, match="no lists of tiles"):
        read_campaign(tmp_path)


def test_tiles_far_from_where_they_are_said_to_be_are_refused(folder: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    here, _ = folder
    for name in ("plate.yaml", "campaign.yaml"):
        (tmp_path / name).write_bytes((here / name).read_bytes())
    grid = (here / "reseau.yaml").read_text().replace("pixel_um: 10.0", "pixel_um: 15.0")
    (tmp_path / "reseau.yaml").write_text(grid)
    (tmp_path / "images").symlink_to(here / "images")
    with pytest.raises(InvalidInput, match=r"row \d+: tile file\d+.png is left out: .*check line_um"):
        run_campaign(tmp_path, tmp_path / "run", until="detect")
