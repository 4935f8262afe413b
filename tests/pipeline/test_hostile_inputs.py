"""What an adversary, or another operating system, puts into a campaign: through the commands, one sentence, no harm."""

import os
import shutil
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from pipeline.cli import app
from tests.pipeline.conftest import Rows, edit_rows, edit_yaml

runner = CliRunner()


def command(campaign: Path, out: Path, *more: str, name: str = "run") -> tuple[int, str]:
    """Exit code and standard error of a command; never a traceback, never an internal error."""
    done = runner.invoke(app, [name, str(campaign), "--out", str(out), "-q", "--workers", "1", *more])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    assert "internal error" not in done.stderr
    assert "Traceback" not in done.output
    return done.exit_code, done.stderr


def refused(campaign: Path, out: Path, *more: str) -> str:
    code, told = command(campaign, out, *more)
    assert code == 1, told
    errors = [line for line in told.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    return errors[0]


def scaled(factor: float, *columns: str) -> Callable[[Rows], None]:
    def change(rows: Rows) -> None:
        for row in rows:
            row.update({name: repr(float(row[name]) * factor) for name in columns})

    return change


XYZ = ("x_mm", "y_mm", "z_mm")
JOINTS = tuple(f"q{k}_deg" for k in range(1, 7))


# --- wrong units -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1e-3, 1 / 25.4, 1e3])
def test_points_in_another_unit(point_campaign: Path, tmp_path: Path, factor: float) -> None:
    edit_rows(point_campaign / "points.csv", scaled(factor, *XYZ))
    told = refused(point_campaign, tmp_path / "run")
    assert "points.csv" in told
    assert "must be in millimetres" in told


def test_body_in_metres(point_campaign: Path, tmp_path: Path) -> None:
    def metres(data: dict) -> None:
        for target in data["targets"]:
            target["xyz_mm"] = [v / 1000 for v in target["xyz_mm"]]

    edit_yaml(point_campaign / "plate.yaml", metres)
    assert "must be in millimetres" in refused(point_campaign, tmp_path / "run")


def test_frames_in_metres_and_in_radians(frame_campaign: Path, tmp_path: Path) -> None:
    table = frame_campaign / "frames.csv"
    content = table.read_bytes()
    edit_rows(table, scaled(1e-3, *XYZ))
    assert "must be in millimetres" in refused(frame_campaign, tmp_path / "run", "--until", "identify")
    table.write_bytes(content)
    edit_rows(table, scaled(np.pi / 180, "roll_deg", "pitch_deg", "yaw_deg"))
    assert "radians" in refused(frame_campaign, tmp_path / "run", "--until", "identify")


def test_joint_angles_in_radians(point_campaign: Path, tmp_path: Path) -> None:
    edit_rows(point_campaign / "poses.csv", scaled(np.pi / 180, *JOINTS))
    assert "radians stand where degrees are expected" in refused(point_campaign, tmp_path / "run")


def test_robot_in_metres_and_payloads_in_grams(point_campaign: Path, tmp_path: Path) -> None:
    def grams(data: dict) -> None:
        for load in data["payloads"].values():
            load["mass_kg"] *= 1000

    def metres(data: dict) -> None:
        for frame in data["frames"]:
            frame["xyz_mm"] = [v / 1000 for v in frame["xyz_mm"]]

    edit_yaml(point_campaign / "campaign.yaml", grams)
    _, told = command(point_campaign, tmp_path / "run", "--until", "measure")
    assert "times as heavy as the robot" in told
    edit_yaml(point_campaign / "robot.yaml", metres)
    assert "must be in millimetres" in refused(point_campaign, tmp_path / "run")


def test_sigmas_in_another_unit(point_campaign: Path, tmp_path: Path) -> None:
    edit_rows(point_campaign / "points.csv", scaled(1e3, "sigma_mm"))
    assert "sigmas are too large" in refused(point_campaign, tmp_path / "run")


def test_scale_bar_in_metres(image_campaign: Path, detected: Path) -> None:
    def metres(data: dict) -> None:
        data["bodies"]["plate"]["survey"]["scale_bars"][0]["length_mm"] /= 1000

    edit_yaml(image_campaign / "campaign.yaml", metres)
    told = refused(image_campaign, detected, "--until", "survey")
    assert "0.001 times" in told
    assert "millimetres" in told


# --- tables of other programs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["\r\n", "\r"])
def test_windows_text_gives_the_same_result(point_campaign: Path, tmp_path: Path, ending: str) -> None:
    assert command(point_campaign, tmp_path / "before", "--until", "frames")[0] == 0
    for path in point_campaign.iterdir():
        if path.suffix == ".csv" or ending == "\r\n":
            text = path.read_text(encoding="utf-8")
            path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", ending).encode())
    assert command(point_campaign, tmp_path / "after", "--until", "frames")[0] == 0
    assert (tmp_path / "after" / "frames.csv").read_bytes() == (tmp_path / "before" / "frames.csv").read_bytes()


def as_text(change: Callable[[str], str], encoding: str = "utf-8") -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        path.write_bytes(change(path.read_text(encoding="utf-8")).encode(encoding))

    return spoil


def replaced(content: bytes) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        path.write_bytes(content)

    return spoil


def comma_in_first_number(text: str) -> str:
    head, first, *rest = text.splitlines()
    cells = first.split(",")
    cells[2] = f'"{cells[2].replace(".", ",")}"'
    return "\n".join([head, ",".join(cells), *rest])


def with_note(text: str) -> str:
    return text.replace("\n", ",ü\n").replace("sigma_mm,ü", "sigma_mm,note")


ALIASES = b"".join(b"%c: &%c [*%c, *%c]\n" % (k + 1, k + 1, k, k) for k in range(97, 120))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (as_text(lambda t: t.replace(",", ";").replace(".", ",")), "separated by semicolons"),
        (as_text(lambda t: t.replace(",", "\t")), "separated by tabs"),
        (as_text(comma_in_first_number), "row 2: x_mm is"),
        (as_text(with_note, "latin-1"), "row 2: is not UTF-8"),
        (as_text(lambda t: t, "utf-16"), "UTF-16"),
        (replaced(b""), "is empty"),
        (replaced(b"pose,target,x_mm,y_mm,z_mm\n"), "lists no measurements"),
        (replaced(b"pose,target,x_mm,y_mm,z_mm\n" + b"a" * 10_000_000), "row 2: not a CSV table"),
        (replaced(b"pose,target,x_mm,y_mm,z_mm\n" + b"," * 10_000_000), "lists no measurements"),
        (replaced(b"\x00" * 1000), "is not a text file"),
        (replaced(b"pose,target,x_mm,y_mm,z_mm\n" + b"p001,1_7,1,2,3\n"), "'1_7'"),
        (replaced(b"pose,target,x_mm,y_mm,z_mm\n" + b"p001,17,1_000,2,3\n"), "'1_000', not a number"),
        (replaced(b"pose,target,x_mm,y_mm,z_mm\n" + b"p001,17,1e999,2,3\n"), "x_mm is"),
    ],
)
def test_tables_that_cannot_be_meant(
    point_campaign: Path, tmp_path: Path, spoil: Callable[[Path], None], words: str
) -> None:
    spoil(point_campaign / "points.csv")
    told = refused(point_campaign, tmp_path / "run")
    assert "points.csv" in told
    assert words in told
    assert len(told) < 600


@pytest.mark.slow
def test_a_million_rows(point_campaign: Path, tmp_path: Path) -> None:
    row = "p001,9,1,2,3\n"
    (point_campaign / "points.csv").write_text("pose,target,x_mm,y_mm,z_mm\n" + row * 1_000_000)
    assert "row 3: pose p001, target 9 stands twice" in refused(point_campaign, tmp_path / "run")


# --- files that are none --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["folder", "link to itself", "link to nowhere", "pipe"])
@pytest.mark.parametrize("name", ["points.csv", "plate.yaml", "campaign.yaml"])
def test_no_file_where_one_is_needed(point_campaign: Path, tmp_path: Path, name: str, kind: str) -> None:
    path = point_campaign / name
    path.unlink()
    _put(path, kind)
    assert name in refused(point_campaign, tmp_path / "run")


def _put(path: Path, kind: str) -> None:
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to(path.name if kind == "link to itself" else "nowhere")


@pytest.mark.parametrize("kind", ["folder", "link to itself", "link to nowhere", "pipe"])
def test_no_image_under_an_image_name(image_campaign: Path, detected: Path, kind: str) -> None:
    path = image_campaign / "station" / "left" / "p001.png"
    path.unlink()
    _put(path, kind)
    told = refused(image_campaign, detected, "--until", "detect")
    assert str(path) in told
    assert "remove or rename it" in told


def test_linked_files_and_folders_are_read(image_campaign: Path, detected: Path, tmp_path: Path) -> None:
    shutil.move(image_campaign / "station" / "left", tmp_path / "left")
    (image_campaign / "station" / "left").symlink_to(tmp_path / "left")
    assert command(image_campaign, detected, "--until", "detect")[0] == 0


def png(width: int, height: int, data: bytes, depth: int = 8, kind: int = 0) -> bytes:
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty image file"),
        (b"hello", "is not a PNG"),
        (b"GIF89a" + bytes(100), "is not a PNG"),
        (png(640, 512, zlib.compress(bytes(100))), "corrupt image"),
        (png(200_000, 200_000, zlib.compress(bytes(1000))), "pixels are more than"),
        (png(15_000, 15_000, zlib.compress(bytes(1000)), 16, 6), "GB of colour values"),
        (png(1, 1, zlib.compress(bytes(2))), "at least 8 x 8"),
    ],
)
def test_image_files_that_are_none(image_campaign: Path, detected: Path, content: bytes, words: str) -> None:
    path = image_campaign / "station" / "left" / "p001.png"
    path.write_bytes(content)
    told = refused(image_campaign, detected, "--until", "detect")
    assert str(path) in told
    assert words in told


def test_tiff_of_endless_directories_and_of_a_giant(image_campaign: Path, detected: Path) -> None:
    path = image_campaign / "station" / "left" / "p001.png"
    path.unlink()
    tiff = path.with_suffix(".tif")
    tiff.write_bytes(b"II*\0" + struct.pack("<IHI", 8, 0, 8))
    assert "corrupt image" in refused(image_campaign, detected, "--until", "detect")
    tags = [(256, 4, 100_000), (257, 4, 100_000), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8), (279, 4, 9)]
    body = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    tiff.write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + body + bytes(4))
    assert "100000 x 100000 pixels are more than" in refused(image_campaign, detected, "--until", "detect")


def test_files_of_operating_systems_beside_the_images(image_campaign: Path, detected: Path) -> None:
    folder = image_campaign / "station" / "left"
    for name in ("Thumbs.db", ".DS_Store", "._p001.png", "notes.txt"):
        (folder / name).write_bytes(b"x")
    code, told = command(image_campaign, detected, "--until", "detect")
    assert (code, told) == (0, "")


# --- campaign.yaml --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (bytes(100), "control character"),
        (b"format: robcal/campaign-1\n\tname: x\n", "line 2: not valid YAML"),
        (b'format: robcal/campaign-1\nname: "a\\nb"\n', "must be a plain name"),
        (b'format: robcal/campaign-1\nname: x\nmeasurements: "po\\0ints.csv"\n', "printable"),
        (b"format: robcal/campaign-1\nname: x\nmeasurements: " + b"a" * 5000, "at most 1000"),
        (b"a: &a [x, x]\n" + ALIASES, "aliases"),
        (b"format: !!python/object/apply:os.system ['true']\n", "not valid YAML"),
        (b"[" * 1200, "not valid YAML"),
        ("format: robcal/campaign-1\nname: Zellä\n".encode("latin-1"), "line 2: not UTF-8"),
    ],
)
def test_hostile_campaign_files(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "campaign.yaml").write_bytes(content)
    told = refused(tmp_path, tmp_path / "run")
    assert "campaign.yaml" in told
    assert words in told or "nested too deeply" in told


def test_devices_are_not_read(point_campaign: Path, tmp_path: Path) -> None:
    edit_yaml(point_campaign / "campaign.yaml", lambda d: d.update(measurements="/dev/zero"))
    assert "is a folder or a device" in refused(point_campaign, tmp_path / "run")


# --- names, places, rights ------------------------------------------------------------------------------------------


def test_blanks_and_umlauts_in_names(image_campaign: Path, detected: Path) -> None:
    station = image_campaign / "station"
    (station / "left").rename(station / "linke Kämera 1")
    for path in (image_campaign / "survey" / "plate").iterdir():
        path.rename(path.with_name(f"Bild ä {path.name}"))

    def rename(data: dict) -> None:
        data["name"] = "Zelle 7 Süd"
        data["station"]["cameras"] = {
            "linke Kamera ä": {"images": "station/linke Kämera 1", "calibration": "left.yaml"},
            "right": data["station"]["cameras"]["right"],
        }

    edit_yaml(image_campaign / "campaign.yaml", rename)
    assert command(image_campaign, detected, "--until", "orient")[0] == 0
    assert (detected / "cameras" / "linke Kamera ä.yaml").is_file()


def test_backslashes_of_windows_in_paths(image_campaign: Path, detected: Path) -> None:
    def windows(data: dict) -> None:
        data["bodies"]["plate"]["survey"]["images"] = "survey\\plate"
        data["station"]["cameras"]["left"]["images"] = "station\\left"

    edit_yaml(image_campaign / "campaign.yaml", windows)
    assert command(image_campaign, detected, "--until", "detect")[0] == 0


@pytest.mark.skipif(os.name == "nt", reason="file names are text there")
def test_folder_name_in_another_encoding(frame_campaign: Path, tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/Anlage-K\xf6ln"))
    shutil.move(frame_campaign, folder)
    out = folder.parent / f"{folder.name}-run"
    for _ in range(2):
        done = runner.invoke(app, ["run", str(folder), "--out", str(out), "--until", "verify", "--json"])
        assert done.exit_code == 0, done.output
    assert "verify: up to date" in done.stderr
    assert runner.invoke(app, ["report", str(out), "-q"]).exit_code == 0


def test_relative_paths_from_another_folder(point_campaign: Path, tmp_path: Path) -> None:
    away = tmp_path / "away"
    away.mkdir()
    program = [sys.executable, "-m", "pipeline.cli", "run", os.path.relpath(point_campaign, away), "--until", "measure"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(["/".join(__file__.split("/")[:-3]), *sys.path])}
    subprocess.run([*program, "-q"], cwd=away, env=environment, check=True, timeout=120)
    name = yaml.safe_load((point_campaign / "campaign.yaml").read_text())["name"]
    # beside the campaign, wherever the command was given
    run = point_campaign.parent / "runs" / name
    assert (run / "points.csv").is_file()
    assert not list(away.iterdir())
    # the same run named from elsewhere goes on where it was
    done = runner.invoke(app, ["run", str(point_campaign / "campaign.yaml"), "--out", str(run), "--until", "measure"])
    assert "measure: up to date" in done.stderr


def test_another_campaign_of_the_same_name_does_not_take_the_run_over(point_campaign: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert command(point_campaign, out, "--until", "measure")[0] == 0
    other = Path(shutil.copytree(point_campaign, tmp_path / "other"))
    told = refused(other, out, "--until", "measure")
    assert "another campaign" in told
    assert str(point_campaign) in told
    assert "--out" in told
    # one that has moved is the same one, and this is said
    shutil.rmtree(point_campaign)
    done = runner.invoke(app, ["run", str(other), "--out", str(out), "--until", "measure"])
    assert done.exit_code == 0
    assert f"the campaign was at {point_campaign}" in done.stderr
    assert "measure: up to date" in done.stderr


def test_recordings_are_never_overwritten(image_campaign: Path, point_campaign_source: Path, tmp_path: Path) -> None:
    campaign = Path(shutil.copytree(point_campaign_source, tmp_path / "recorded"))
    other = tmp_path / "notes"
    other.mkdir()
    (other / "points.csv").write_text("mine")
    assert "would be overwritten" in refused(campaign, other)
    assert (other / "points.csv").read_text() == "mine"
    assert "never written to" in refused(campaign, campaign)
    assert "holds recordings" in refused(image_campaign, image_campaign / "station" / "left")


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="needs rights that hold")
def test_without_rights_to_write(point_campaign: Path, tmp_path: Path) -> None:
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o500)
    assert "no permission" in refused(point_campaign, closed / "run")


def test_a_campaign_on_a_read_only_folder(point_campaign: Path, tmp_path: Path) -> None:
    for path in [*point_campaign.iterdir(), point_campaign]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    assert command(point_campaign, tmp_path / "run", "--until", "measure")[0] == 0
    point_campaign.chmod(0o755)


def test_stages_in_the_wrong_order_are_wrong_use(point_campaign: Path, tmp_path: Path) -> None:
    code, told = command(point_campaign, tmp_path / "run", "--from", "verify", "--until", "frames")
    assert code == 2
    assert "comes before" in told
    assert len(told.splitlines()) == 1
    assert not (tmp_path / "run").exists()


def test_black_and_white_and_noise_are_left_out(image_campaign: Path, detected: Path) -> None:
    rng = np.random.default_rng(0)
    pictures = [np.full((512, 640), 255, np.uint8), rng.integers(0, 255, (512, 640), dtype=np.uint8)]
    for number, picture in enumerate(pictures, start=1):
        cv2.imwrite(str(image_campaign / "station" / "left" / f"p00{number}.png"), picture)
    assert command(image_campaign, detected, "--until", "detect")[0] == 0
    notes = (detected / "log.txt").read_text(encoding="utf-8")
    assert notes.count("the image is left out") == 2
