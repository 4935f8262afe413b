"""What the robot stages work on: the measurements as observation operators, for identification and for diagnosis."""

from dataclasses import replace

import numpy as np

from pipeline.artifacts import FRAMES, POINTS
from pipeline.bodies import body_for_robot, surveyed_or_given
from pipeline.campaign import Campaign, InstrumentSource
from pipeline.campaign_schema import InstrumentEntry
from pipeline.correction import load_correction
from pipeline.runs import Run
from robcal.calibration.closed_loops import loop_observations
from robcal.calibration.instruments import Instrument
from robcal.calibration.instruments.loops import loop_frame, start_of_loops
from robcal.calibration.measurements import RobotObservations, RobotRecording, frame_observations, used_points
from robcal.calibration.observations import DistanceObservations, FrameObservations
from robcal.calibration.wire import USUAL_TENSION, Wire
from robcal.errors import DegenerateGeometry, InvalidInput
from robcal.files.measurement_tables import MeasuredTable
from robcal.files.recordings import observations_of
from robcal.photogrammetry.core.bodies import Body
from robcal.recipe.wires import Correction
from robcal.robot.hexapod import nominal_frames
from robcal.transforms import Array


def build_instruments(campaign: Campaign, run: Run) -> list[Instrument]:
    """The instruments of a campaign with their measurements.

    Raises
    ------
    InvalidInput : measurements that lack the coordinates they refer to.
    """
    out = []
    for name, source in campaign.instruments.items():
        if source.tables and any(table.kind == "constraints" for table in source.tables):
            out += _closed_loops(campaign, name, source)
            continue
        if name == "station" or (name == "measurements" and campaign.entry.station is None):
            tables = () if name == "station" else campaign.measurements
            recording = build_recording(replace(campaign, measurements=tables), run, body_for_robot(campaign, run))
        else:
            seen = source.entry.body if source.entry is not None and source.entry.body else campaign.carried_body
            body = surveyed_or_given(campaign, run, seen) if seen is not None else None
            tables = source.tables or ()
            observations = tuple(_on_wire(observations_of(table, body), source.entry) for table in tables)
            stated = all(table.covariance is not None for table in tables)
            recording = RobotRecording(observations, observations, stated)
        pulley = None if source.entry is None else source.entry.pulley
        wire = ("radius",) if pulley is not None and pulley.free == "radius" else ()
        out.append(Instrument(name, recording, source.world, source.tool, wire))
    return out


def _closed_loops(campaign: Campaign, name: str, source: InstrumentSource) -> list[Instrument]:
    """The closed loops of an instrument's tables, each with a world of its own, all with the same tool.

    Raises
    ------
    InvalidInput : other measurements beside them, or no robot.
    """
    tables = source.tables or ()
    robot, poses = campaign.robot, campaign.poses
    if robot is None or poses is None or any(table.kind != "constraints" for table in tables):
        raise InvalidInput(f"instrument '{name}': closed loops are an instrument of their own, of a robot with poses")
    loops = [
        (loop, loop_observations(kind, t.pose[rows], t.values[rows], np.sqrt(_variance(t)[rows])), kind)
        for t in tables
        for k, (loop, kind) in enumerate(t.loops.items())
        if len(rows := np.flatnonzero(t.loop == k))
    ]
    flange = nominal_frames(robot, poses.q)
    try:
        placed = start_of_loops([(kind, flange[o.pose]) for _, o, kind in loops], source.tool)
    except DegenerateGeometry as error:
        raise InvalidInput(f"{tables[0].path}: {error}: spread the poses of each constraint") from None
    tool, worlds = placed
    return [
        Instrument(
            f"{name}-{loop}",
            RobotRecording((o,), (o,), True),
            loop_frame(f"{name}-{loop}", kind, world),
            tool,
            (),
            kind,
        )
        for (loop, o, kind), world in zip(loops, worlds, strict=True)
    ]


def _variance(table: MeasuredTable) -> Array:
    if table.covariance is None:
        raise InvalidInput(f"{table.path}: sigma_mm is missing: how well a closed loop holds must be known")
    return table.covariance


def _on_wire(made: RobotObservations, entry: InstrumentEntry | None) -> RobotObservations:
    """Lengths as the wire of their instrument is drawn, where anything of it is stated."""
    if entry is None or not isinstance(made, DistanceObservations) or not (entry.pulley or entry.tension_N):
        return made
    wire = Wire(tension=entry.tension_N or USUAL_TENSION)
    if entry.pulley is not None:
        wire = replace(wire, radius=entry.pulley.radius_mm / 1000.0, axis=entry.pulley.axis)
    return replace(made, wire=wire)


def corrections_of(campaign: Campaign) -> dict[str, Correction]:
    """Functions from outside that correct the lengths of wires, by the name of the instrument.

    Raises
    ------
    InvalidInput : no such module or function.
    """
    entries = campaign.entry.instruments.items()
    return {
        name: load_correction(entry.correction, campaign.path.parent, f"instrument '{name}'")
        for name, entry in entries
        if entry.correction is not None
    }


def build_recording(campaign: Campaign, run: Run, body: Body | None) -> RobotRecording:
    """Observations of the campaign's measurements, from tables or from the stages before.

    Raises
    ------
    InvalidInput : nothing measured, or measurements that lack the coordinates they refer to.
    """
    observations: list[RobotObservations] = []
    detailed: list[RobotObservations] = []
    stated = True
    notes: list[str] = []
    frames = run.find(FRAMES)
    if frames is not None:
        points = run.load(POINTS)
        stated &= points.covariance is not None
        if len(frames.pose):
            observations.append(frame_observations(points, frames))
            # What points of the own station tell about targets and cameras is judged in its images. The robot is
            # diagnosed on the frames with their own noise alone: what they share is told apart (common_errors).
            if points.station_jacobian is not None:
                detailed.append(FrameObservations(frames.pose, frames.world_T_body, frames.covariance))
            else:
                detailed.append(used_points(points, frames, body) or observations[-1])
    for table in campaign.measurements:
        if table.kind == "points" and frames is not None:
            continue
        made = observations_of(table, body)
        stated &= table.covariance is not None
        observations.append(made)
        detailed.append(made)
    if not observations:
        raise InvalidInput(f"{campaign.path}: nothing was measured of the robot: no pose is left to identify from")
    if not stated:
        notes.append("the measurements state no uncertainty: it is estimated from the residuals")
    return RobotRecording(tuple(observations), tuple(detailed), stated, tuple(notes))
