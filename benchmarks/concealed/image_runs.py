"""Batteries of robots with their own station, from rendered images to the diagnosis."""

import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.concealed.own_runs import ROBOTS
from benchmarks.concealed.own_scoring import diagnosed
from fixtures.draws import NotDrawable
from fixtures.image_files import Spoil
from fixtures.optics import Sensor
from fixtures.own_images import IMAGE_CAUSES, SURVEY_LENS, Photographs, draw_image_effect, image_plan, make_own_images
from fixtures.own_station import OwnPlan

SNRS = (12.0, 30.0)
SPOILT: tuple[tuple[str, Spoil], ...] = (
    ("left/p003", "black"),
    ("right/p005", "white"),
    ("left/p008", "blurred"),
    ("right/p010", "other"),
)
NULLS: Mapping[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "plain": ({}, {}),
    "noisy images": ({"sigma_px": 0.06}, {"sensor": Sensor(full_well=2500.0, read_noise=30.0)}),
    "glints and hoses": ({}, {"distractors": 60, "cables": 0.25}),
    "bad images": ({}, {"spoilt": SPOILT}),
    "repeatability": ({"joint_repeatability_rad": 15e-6}, {}),
}
"""Kinds of nulls: what they change of the plan, and of how it is photographed."""
NEED_SURVEY = (*SURVEY_LENS, "scale_error")
KEEP = "CONCEALED_KEEP"
"""Environment variable: folder in which campaigns and runs are kept, for a look at them."""


@dataclass(frozen=True)
class Imaged:
    """One campaign of images; ``label`` is a kind of null or a cause."""

    battery: str
    label: str
    seed: int
    snr: float | None
    level: str = "images"

    @property
    def key(self) -> str:
        """Unique name, also for resuming."""
        return f"{self.battery}/{self.label}/{self.level}/{self.seed}/{self.snr}"

    @property
    def plan(self) -> OwnPlan:
        """Robots, plates and numbers of cameras take turns."""
        cameras = 3 if self.seed % 5 == 4 else 2
        changes = NULLS[self.label][0] if self.snr is None else {}
        return image_plan(self.seed, self.label, robot=ROBOTS[self.seed // 2 % 4], cameras=cameras, **changes)

    @property
    def photographs(self) -> Photographs:
        """Every other plate is surveyed, the others are certified."""
        surveyed = self.seed % 2 == 0 or self.label in NEED_SURVEY
        changes = NULLS[self.label][1] if self.snr is None else {}
        return Photographs(survey_images=14 if surveyed else 0, **changes)


def image_runs(battery: str, count: int, seed: int) -> Iterator[Imaged]:
    """``nulls`` or ``singles``: every cause once, at one SNR and the other in turn."""
    for i in range(count):
        labels = NULLS if battery == "nulls" else IMAGE_CAUSES
        for k, label in enumerate(labels):
            yield Imaged(battery, label, seed + 100 * i + k, None if battery == "nulls" else SNRS[(i + k) % 2])


def run_imaged(imaged: Imaged) -> dict[str, Any]:
    """Render, run and score one campaign; a failure of the tool is a record with ``error``."""
    record: dict[str, Any] = {"key": imaged.key, "battery": imaged.battery, "label": imaged.label}
    plan = imaged.plan
    record |= {"level": imaged.level, "snr": imaged.snr, "seed": imaged.seed, "robot": plan.robot}
    with tempfile.TemporaryDirectory(prefix="concealed-") as folder:
        root = Path(folder)
        try:
            effects = () if imaged.snr is None else (draw_image_effect(plan, imaged.label, imaged.snr),)
        except NotDrawable as error:
            return {**record, "skipped": str(error)}
        start = time.process_time()
        truth = make_own_images(root / "campaign", replace(plan, effects=effects), imaged.photographs)
        record["rendering_seconds"] = time.process_time() - start
        record |= diagnosed(root, truth)
        if KEEP in os.environ:
            shutil.copytree(root, Path(os.environ[KEEP]) / f"{imaged.label}-{imaged.seed}", dirs_exist_ok=True)
    return record
