"""Stage measure: targets in the world, by forward intersection or from the tables of another system."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from pipeline.artifacts import MARKS, ORIENTATION, POINTS
from pipeline.bodies import surveyed_or_given
from pipeline.campaign import Campaign
from pipeline.runs import Run
from pipeline.stages.base import Context, Outcome, Stage
from robcal.errors import InvalidInput
from robcal.files.measurement_tables import MeasuredTable, SharedErrors
from robcal.files.poses_table import Poses
from robcal.files.tables import write_table
from robcal.photogrammetry.measure.exchanged import exchanged_back, find_exchanges
from robcal.photogrammetry.measure.measured_points import MeasuredPoints
from robcal.photogrammetry.measure.points import measure_points

NAME = "measure"


def applies(campaign: Campaign) -> bool:
    """Whether there are points, or cameras to intersect them."""
    return campaign.entry.station is not None or bool(campaign.measured("points"))


def work(context: Context) -> Outcome:
    """Measure all targets in all poses."""
    campaign, run = context.campaign, context.run
    if campaign.poses is None:
        raise InvalidInput(f"{campaign.path}: no poses: add 'poses: poses.csv'")
    points = (
        measure_points(run.load(ORIENTATION), run.load(MARKS))
        if campaign.entry.station is not None
        else _right_numbers(campaign, run)
    )
    write_points(run, campaign.poses, points)
    names = campaign.poses.names
    notes = [f"pose '{names[p]}': the rays of the cameras contradict one another" for p in points.inconsistent_poses]
    if points.resected is not None and len(points.resected.pose):
        notes.append(f"{len(points.resected.pose)} poses by resection from one camera")
    notes += [
        f"targets {x.targets[0]} and {x.targets[1]} carry each other's number in {len(x.poses)} pose(s) "
        f"({', '.join(names[p] for p in x.poses[:6])}{' ...' if len(x.poses) > 6 else ''}): lengths on the body "
        f"miss by {1000 * x.before:.3g} mm, exchanged by {1000 * x.after:.2g} mm; used exchanged: correct the table"
        for x in points.exchanges
    ]
    result = {"measured": len(points.pose), "rejected": len(points.rejected)}
    return Outcome({"points": result}, [run.save(POINTS, points), run.points], notes)


def _right_numbers(campaign: Campaign, run: Run) -> MeasuredPoints:
    points, name = points_from_tables(campaign), campaign.carried_body
    if name is None:
        return points
    return exchanged_back(points, find_exchanges(points, surveyed_or_given(campaign, run, name)))


def points_from_tables(campaign: Campaign) -> MeasuredPoints:
    """Points of all tables together.

    Raises
    ------
    InvalidInput : some tables state their uncertainty and others do not, or a target is measured twice in a pose.
    """
    tables = campaign.measured("points")
    stated = [table.covariance is not None for table in tables]
    if any(stated) and not all(stated):
        without = tables[stated.index(False)].path
        raise InvalidInput(f"{without}: states no uncertainty while other tables do: add the column sigma_mm")
    covariance = np.concatenate([t.covariance for t in tables if t.covariance is not None]) if all(stated) else None
    points = MeasuredPoints.from_table(
        np.concatenate([t.pose for t in tables]),
        np.concatenate([t.target for t in tables]),
        np.concatenate([t.values for t in tables]),
        covariance,
    )
    return _with_shared(points, tables)


def _with_shared(points: MeasuredPoints, tables: Sequence[MeasuredTable]) -> MeasuredPoints:
    """The points with what those of each calibrated system have in common apart from their own noise."""
    if all(table.shared is None for table in tables) or points.covariance is None:
        return points
    shared = [t.shared or SharedErrors.none(t.covariance) for t in tables if t.covariance is not None]
    widths = np.cumsum([0, *(s.jacobian.shape[2] for s in shared)])
    jacobian = [
        np.pad(s.jacobian, ((0, 0), (0, 0), (at, widths[-1] - at - s.jacobian.shape[2])))
        for s, at in zip(shared, widths, strict=False)
    ]
    return replace(
        points,
        covariance=np.concatenate([s.noise for s in shared]),
        station_jacobian=np.concatenate(jacobian),
        station_covariance=block_diag(*(s.covariance for s in shared if len(s.covariance))),
    )


def write_points(run: Run, poses: Poses, points: MeasuredPoints) -> None:
    """points.csv of the run."""
    columns: dict[str, list[object]] = {
        "pose": [poses.names[i] for i in points.pose],
        "target": [int(t) for t in points.target],
    }
    for k, name in enumerate("xyz"):
        columns[f"{name}_mm"] = [f"{v:.6f}" for v in points.p_world[:, k] * 1000]
    covariance = points.total_covariance
    if covariance is not None:
        for name, i, j in (("xx", 0, 0), ("xy", 0, 1), ("xz", 0, 2), ("yy", 1, 1), ("yz", 1, 2), ("zz", 2, 2)):
            columns[f"s{name}_mm2"] = [f"{v:.9g}" for v in covariance[:, i, j] * 1e6]
    columns["cameras"] = [int(c) for c in points.n_cameras]
    write_table(run.points, columns)


STAGE = Stage(
    name=NAME,
    applies=applies,
    work=work,
    inputs=lambda campaign: [
        *(path for table in campaign.measured("points") for path in (table.path, *table.sources)),
        *(body.file.path for body in campaign.bodies.values()),
    ],
    settings=lambda campaign: [
        list(campaign.poses.names) if campaign.poses else [],
        [m.model_dump() for m in campaign.entry.measurements],
    ],
    after=("detect", "survey", "orient"),
    module=__name__,
)
