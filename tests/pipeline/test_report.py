"""The report's content: what it says is what the run holds, nothing from outside gets in or out."""

import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fixtures.campaigns import make_campaign
from pipeline.artifacts import EVIDENCE
from pipeline.report import write_report
from pipeline.report.blocks import Figure
from pipeline.report.diagnosis_chapter import _gain
from pipeline.report.style import label, number, probability
from pipeline.runner import run_campaign
from pipeline.runs import Run, open_run
from tests.pipeline.conftest import Rows, edit_rows, edit_yaml

HOSTILE = "<script>alert(1)<img src=x onerror=alert(1)>"  # names of campaigns have no slash
HOSTILE_POSE = "</script><script>alert(2)</script>"


class Page(HTMLParser):
    """Tags, texts outside scripts, and the content of scripts."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []
        self.text = ""
        self._script: dict[str, str | None] | None = None
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._script = dict(attrs) if tag == "script" else None

    def handle_endtag(self, tag: str) -> None:
        self._script = None

    def handle_data(self, data: str) -> None:
        if self._script is None:
            self.text += data + " "
        else:
            self.scripts.append((self._script, data))

    @property
    def chapters(self) -> list[str]:
        return [str(a.get("id")) for t, a in self.tags if t == "section" and "chapter" in str(a.get("class")).split()]

    @property
    def figures(self) -> list[dict]:
        return [json.loads(text) for attrs, text in self.scripts if attrs.get("type") == "application/json"]


def hostile(rows: Rows) -> None:
    for row in rows:
        if row["pose"] == "p002":
            row["pose"] = HOSTILE_POSE


@pytest.fixture(scope="session")
def diagnosed(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run with a strong backlash and names meant to break the page."""
    folder = tmp_path_factory.mktemp("report")
    make_campaign(folder / "campaign", seed=101, poses=60, verify=12, effects=["backlash"], snr=15)
    edit_yaml(folder / "campaign" / "campaign.yaml", lambda d: d.update(name=HOSTILE, tolerance_mm=0.2))
    for name in ("poses.csv", "points.csv"):
        edit_rows(folder / "campaign" / name, hostile)
    return run_campaign(folder / "campaign", folder / "run", workers=1).run


@pytest.fixture(scope="session")
def page(diagnosed: Run) -> Page:
    return Page(diagnosed.report)


def test_hostile_names_stay_text(page: Page) -> None:
    assert HOSTILE in page.text  # shown as it is written
    assert all("alert(" not in script or attrs.get("type") == "application/json" for attrs, script in page.scripts)
    assert not [a for t, a in page.tags if t == "img" and a.get("src") == "x"]
    raw = [text for attrs, text in page.scripts if attrs.get("type") == "application/json"]
    assert not any("<" in text for text in raw)


def test_nothing_is_requested_from_outside(page: Page, diagnosed: Run) -> None:
    for _, attributes in page.tags:
        for key in ("src", "href", "srcset", "action", "data"):
            assert str(attributes.get(key, "#")).startswith(("#", "data:image/jpeg;base64,")), attributes
    policy = next(str(a["content"]) for t, a in page.tags if t == "meta" and "http-equiv" in a)
    assert "default-src 'none'" in policy
    assert "script-src 'sha256-" in policy
    assert "unsafe-inline" not in policy.split("script-src")[1].split(";")[0]
    assert diagnosed.report.stat().st_size < 8e6


def test_the_top_says_what_result_json_says(page: Page, diagnosed: Run) -> None:
    result = json.loads(diagnosed.result.read_text())
    tools = result["verification"]["tools"]["0"]
    nominal = result["verification"]["nominal"]["0"]
    assert f"falls from {number(nominal['mean'])} to {number(tools['mean'])} mm" in page.text
    assert number(result["verification"]["iso9283"]["AP_mean_mm"]) in page.text
    diagnosis = json.loads(diagnosed.diagnosis.read_text())
    assert diagnosis["causes"][0]["cause"] == "backlash"
    assert diagnosis["statement"] in re.sub(r"\s+", " ", page.text)


def test_the_verdict_judges_by_the_tolerance(page: Page, diagnosed: Run) -> None:
    verdict = json.loads(diagnosed.result.read_text())["verdict"]
    told = verdict["tolerance"]
    assert told["tolerance_mm"] == pytest.approx(0.2)
    assert told["kept"] == (told["largest_mm"] <= 0.2)
    assert told["within"] + told["beyond"] + told["undecided"] == told["places"]
    assert told["statement"] in re.sub(r"\s+", " ", page.text)


def test_chapters_appear_only_where_there_is_data(page: Page) -> None:
    chapters = page.chapters
    assert chapters[:3] == ["verification", "workspace", "diagnosis"]
    # results stand before the evidence
    assert chapters.index("files") < chapters.index("parameters")
    assert {"measurement", "network", "files", "provenance"} <= set(chapters)
    assert not {"survey", "images", "residuals"} & set(chapters)


def test_provenance_lists_every_input(page: Page, diagnosed: Run) -> None:
    for name in ("campaign.yaml", "poses.csv", "points.csv", "robot.yaml"):
        assert name in page.text
    assert len(re.findall(r"\b[0-9a-f]{64}\b", page.text)) >= 4


def test_evidence_agrees_with_its_law_also_on_poses_kept_out(diagnosed: Run) -> None:
    evidence = diagnosed.load(EVIDENCE)
    cause = evidence.causes[0]
    pull = (cause.measured - cause.fitted) / cause.sigma
    assert evidence.kind == "verify"
    assert cause.kept_out.sum() >= 6
    # what a pose says scatters about the law by its own sigma; without the law the poses contradict one another
    assert 0.6 < np.mean(pull**2) < 1.5
    assert np.mean(pull[cause.kept_out] ** 2) < 2.5
    assert np.mean((cause.measured / cause.sigma) ** 2) > 1.3 * np.mean(pull**2)
    assert np.mean(evidence.after**2) < np.mean(evidence.before**2)


def test_the_same_run_gives_the_same_report(diagnosed: Run) -> None:
    before = diagnosed.report.read_bytes()
    assert write_report(open_run(diagnosed.folder)).read_bytes() == before


def test_a_report_without_its_campaign(diagnosed: Run, tmp_path: Path) -> None:
    folder = shutil.copytree(diagnosed.folder, tmp_path / "run")
    state = folder / "state" / "run.json"
    data = json.loads(state.read_text())
    state.write_text(json.dumps(data | {"campaign": str(tmp_path / "gone")}))
    page = Page(write_report(open_run(folder)))
    assert "verification" in page.chapters
    assert "the campaign is gone" in page.text


@pytest.mark.parametrize("level", ["frames", "distances"])
def test_other_measurements(level: str, tmp_path: Path) -> None:
    make_campaign(tmp_path / "campaign", seed=3, level=level, poses=50, verify=10)
    edit_yaml(tmp_path / "campaign" / "campaign.yaml", lambda d: d.update(diagnosis={"enabled": False}))
    page = Page(run_campaign(tmp_path / "campaign", tmp_path / "run", workers=1).run.report)
    assert "verification" in page.chapters
    assert "diagnosis" not in page.chapters
    assert ("AP, ISO 9283" in page.text) == (level == "frames")


def test_images_are_embedded_with_what_was_found(image_run: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(image_run, tmp_path / "run")
    page = Page(write_report(open_run(folder)))
    pictures = [a for t, a in page.tags if t == "image"]
    assert pictures
    assert all(str(a["href"]).startswith("data:image/jpeg;base64,") for a in pictures)
    assert len([a for t, a in page.tags if t == "svg" and a.get("role") == "img" and a["aria-label"]]) == len(pictures)
    marks = [a for t, a in page.tags if t == "g" and "mark" in str(a.get("class"))]
    residuals = [a for t, a in page.tags if t == "path" and a.get("class") == "residual"]
    assert len(marks) > len(residuals) > 10 * len(pictures) / 2
    posed = [a for t, a in page.tags if t == "figure" and a.get("data-pose")]
    assert len(posed) > len(pictures) / 2
    assert "images" in page.chapters


def test_figures_hold_no_value_that_json_has_not() -> None:
    figure = Figure(({"x": [1.0, float("nan")], "name": "</script><b>"},), {}, "", "")
    assert json.loads(figure.payload)["data"][0]["x"] == [1.0, None]
    assert "<" not in figure.payload


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0491552, "0.0492"), (12345.6, "12346"), (0, "0"), (None, "–"), (float("nan"), "–"), (-2.5, "-2.50")],
)
def test_numbers(value: float | None, text: str) -> None:
    assert number(value) == text


def test_words_for_plots_and_probabilities() -> None:
    assert label("<b>") == "&lt;b&gt;"
    assert probability(1e-30) == "below 1e-12"
    assert probability(0.034) == "0.034"


def test_errors_before_and_after_are_told_apart_only_where_they_differ() -> None:
    material: Any = SimpleNamespace(evidence=None, identification=None)
    held = {"before": 0.02, "after": 0.02, "noise_floor": 0.01, "kind": "verify", "region": {"before": 1, "after": 1}}
    (same,) = _gain(material, {"mismatch": True, "heldout_mm": held})
    assert "before" not in same.text
    (apart,) = _gain(material, {"mismatch": True, "heldout_mm": held | {"after": 0.015}})
    assert "0.0200 mm (RMS) before and 0.0150 after" in apart.text
