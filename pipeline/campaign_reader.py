"""Reading and checking a campaign folder; see :mod:`pipeline.campaign` for what it yields."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from pipeline.campaign import BodySource, Campaign, HandEyeSource, ImageSource, InstrumentSource
from pipeline.campaign_checks import Contradiction, contradictions, instrument_contradictions
from pipeline.campaign_schema import FORMAT, CampaignEntry, InstrumentEntry, StationCameraEntry, SurveyEntry, TableUse
from pipeline.correction import module_file
from pipeline.instrument_frames import cell_frames
from pipeline.model_priors import model_priors
from pipeline.pose_images import images_by_stem, match_poses, poses_from_images
from robcal.errors import InvalidInput, RobcalError
from robcal.files.body_file import check_ring_codes, read_body
from robcal.files.camera_file import read_camera
from robcal.files.camera_import import split_choice
from robcal.files.commanded import at_own_angles, commanded_angles
from robcal.files.flange_poses import read_flange_poses
from robcal.files.foreign_tables import read_mapped_table
from robcal.files.images import list_images
from robcal.files.joint_logs import is_joint_log, log_of_robot, read_controller_log
from robcal.files.laser_sensor import read_sensor, sensed_points
from robcal.files.line_cameras import measured_lights, read_line_cameras
from robcal.files.measurement_tables import (
    MeasuredTable,
    check_marks,
    marks_of,
    measurements_of,
    unmeasured,
    without_frozen,
)
from robcal.files.poses_table import Poses, check_rows, poses_of
from robcal.files.reseau_file import list_tiled, read_reseau
from robcal.files.robot_import import read_any_robot
from robcal.files.schemas import parse, parse_leniently, proposal
from robcal.files.tables import FaultyRows, Table, read_table
from robcal.files.yaml_io import read_yaml
from robcal.photogrammetry.core.adjustable import adjustable
from robcal.physics.gravity_sag import without_masses
from robcal.robot.hexapod import nominal_frames
from robcal.robot.model import RobotModel

T = TypeVar("T")


def campaign_file(path: Path) -> Path:
    """The campaign.yaml meant by a folder or a file.

    Raises
    ------
    InvalidInput : there is none.
    """
    if path.is_dir():
        file = path / "campaign.yaml"
        if not file.is_file():
            names = sorted(p.name for p in path.glob("*.y*ml"))
            hint = f" (it has {', '.join(names[:3])}: name the file itself)" if names else " (the folder needs one)"
            raise InvalidInput(f"{path}: no campaign.yaml in this folder{hint}: it says what the recordings are")
        return file
    if not path.exists():
        raise InvalidInput(f"{path}: no such folder or file: name the campaign folder")
    return path


def read_campaign(path: Path | str) -> Campaign:
    """Read and check a campaign.

    Raises
    ------
    InvalidInput : the first contradiction found, with file, row and remedy.
    """
    return _Reader(campaign_file(Path(path))).read()


def read_leniently(path: Path | str) -> tuple[Campaign | None, list[str]]:
    """What can be read of a campaign, and a sentence for every fault found in it; parts with faults are left out.

    Where rows of the table of poses are faulty, ``poses`` lacks them, and measurements are those of all others.
    """
    faults: list[str] = []
    campaign = None
    try:
        campaign = _Reader(campaign_file(Path(path)), faults).read()
    except InvalidInput as error:
        faults.extend(error.faults)
    except RobcalError as error:
        faults.append(str(error))
    return campaign, list(dict.fromkeys(faults))


class _Reader:
    """Reads a campaign; with a list of ``faults`` it notes them there and goes on, else it raises the first."""

    def __init__(self, path: Path, faults: list[str] | None = None) -> None:
        self.path = path
        self.faults = faults
        self.document = read_yaml(path)
        self.whole = True
        if faults is None:
            self.entry = parse(self.document, CampaignEntry, FORMAT)
        else:
            entry, problems = parse_leniently(self.document, CampaignEntry, FORMAT)
            if entry is None:
                raise InvalidInput(problems[0], problems)
            self.entry = entry
            self.whole = not problems
            faults.extend(problems)
        self.notes: list[str] = []
        self.warnings: list[str] = []
        self.pose_names: tuple[str, ...] = ()
        self.files: list[Path] = [path]

    def _part(self, work: Callable[[], T]) -> T | None:
        """A part of the campaign; where faults are noted, None if it has some."""
        try:
            return work()
        except RobcalError as error:
            if self.faults is None:
                raise
            self.faults.extend(error.faults if isinstance(error, InvalidInput) else [str(error)])
        return None

    def _rows(self, use: TableUse, read: Callable[[Table], T]) -> T:
        """What a table says; where faults are noted, what its sound rows say."""
        path, foreign = self._file(use.file), use.table_map()
        try:
            table = read_table(path) if foreign is None else read_mapped_table(path, foreign)
        except FaultyRows as error:
            if self.faults is None:
                raise
            self.faults.extend(error.faults)
            table = error.rest
        while True:
            try:
                return read(table)
            except FaultyRows as error:
                if self.faults is None or not len(error.rest):
                    raise
                self.faults.extend(error.faults)
                table = error.rest

    def _poses(self, use: TableUse, robot: RobotModel | None) -> Poses:
        if use.table_map() is None and is_joint_log(self._place(use.file)):
            table = log_of_robot(read_controller_log(self._file(use.file)), robot)
            self.pose_names = table.columns["pose"]
            return poses_of(table, robot, robot.payloads if robot else ())

        unread = robot is None and self.entry.robot is not None  # its file has faults, told already

        def read(table: Table) -> Poses:
            if not self.pose_names and table.has("pose"):
                self.pose_names = table.columns["pose"]
            if unread:
                check_rows(table, self.entry.payloads if self.whole else None)
            return poses_of(table, robot, robot.payloads if robot else ())

        return self._rows(use, read)

    def read(self) -> Campaign:
        entry = self.entry
        if not self.faults:
            self._refuse(contradictions(entry))
        robot = self._part(self._robot)
        found = {name: self._part(partial(self._body, name)) for name in entry.bodies}
        bodies = {name: body for name, body in found.items() if body is not None}
        poses = None
        if entry.poses is not None:
            poses = self._part(partial(self._poses, entry.poses, robot))
            self.notes.extend(poses.notes if poses is not None else ())
        if robot is not None and entry.poses is not None and not robot.is_hexapod and without_masses(robot):
            self.notes.append(
                "the robot file states no masses (mass_kg, cog_mm): sag under the arm's own weight is identified where "
                "the poses show it, but what another payload does to the arm cannot be predicted"
            )
        if robot is not None:
            self._part(partial(self._check_priors, robot))
        hand_eye = self._part(partial(self._hand_eye, poses))
        if hand_eye is not None and poses is None:
            poses = self._flange_poses()
        cameras = self._part(partial(self._station, poses)) or {}
        if poses is None and entry.poses is None and entry.station is not None:
            poses = poses_from_images(self.path, cameras)
        measurements = self._tables(entry.measurements, robot, poses, bodies)
        instruments = self._part(partial(self._instruments, measurements, robot, poses, bodies)) or {}
        sources = [measurements, *(i.tables for i in instruments.values())]
        if poses is not None and None not in sources:  # a station sees poses in images
            tables = {id(t): t for some in sources for t in some or ()}
            self.warnings.extend(unmeasured(list(tables.values()), self.pose_names))
        if poses is not None and not self.faults:
            poses, measurements, instruments = self._at_own_angles(poses, measurements, instruments)
        return Campaign(
            path=self.path,
            entry=entry,
            document=self.document,
            robot=robot,
            poses=poses,
            bodies=bodies,
            cameras=cameras,
            measurements=measurements,
            instruments=instruments,
            hand_eye=hand_eye,
            notes=tuple(self.notes),
            warnings=tuple(self.warnings),
            files=tuple(dict.fromkeys(self.files)),
        )

    def _tables(
        self, uses: Sequence[TableUse], robot: RobotModel | None, poses: Poses | None, bodies: Mapping[str, BodySource]
    ) -> tuple[MeasuredTable, ...]:
        known = poses.names if poses is not None else ()
        sound = self.faults is None or known == self.pose_names
        places = None
        if robot is not None and poses is not None and sound and poses.q.shape[1]:
            places = nominal_frames(robot, poses.q)[:, :3, 3]

        def read(use: TableUse, table: Table) -> MeasuredTable:
            found = self._measurements(use, table, known if sound else self.pose_names, robot)
            found = found if places is None else without_frozen(found, places, known)
            self._check_targets(table, found, bodies)
            return found

        found = [self._part(partial(self._rows, use, partial(read, use))) for use in uses]
        tables = tuple(table for table in found if table is not None)
        for table in tables:
            self.warnings.extend(table.notes)
        return tables

    def _measurements(
        self, use: TableUse, table: Table, names: Sequence[str], robot: RobotModel | None
    ) -> MeasuredTable:
        if use.sensor is not None:
            path = self._file(use.sensor)
            return replace(
                sensed_points(table, names, read_sensor(path), commanded_angles(table, robot)), sources=(path,)
            )
        if use.line_cameras is None:
            return measurements_of(table, names, q=commanded_angles(table, robot))
        path = self._file(use.line_cameras)
        return replace(measured_lights(table, names, read_line_cameras(path)), sources=(path,))

    def _instruments(
        self,
        measurements: tuple[MeasuredTable, ...],
        robot: RobotModel | None,
        poses: Poses | None,
        bodies: Mapping[str, BodySource],
    ) -> dict[str, InstrumentSource]:
        """All instruments; none where there is but one and nothing is stated of its world, tool or robot's geometry."""
        entry = self.entry
        stated = {"world_T_base": entry.world_T_base, "flange_T_tool": entry.flange_T_tool}
        for key in (k for k, v in stated.items() if v is not None and entry.instruments):
            raise self._error((key,), f"'{key}' serves a campaign with one instrument: state it at the instrument")
        loops = any(table.kind == "constraints" for table in measurements)
        if not entry.instruments and not any(stated.values()) and not loops and not entry.model.priors:
            return {}
        tables: dict[str, tuple[MeasuredTable, ...] | None] = {}
        if entry.station is not None:
            tables["station"] = None
        if measurements:
            tables["measurements"] = measurements
        for name, use in entry.instruments.items():
            if name in tables:
                raise self._error(("instruments", name), f"'{name}' names two instruments: choose another name")
            try:
                tables[name] = self._tables(use.measurements, robot, poses, bodies)
            except InvalidInput as error:
                raise InvalidInput(f"instrument '{name}': {error}") from None
            for table in tables[name] or ():
                self._part(partial(self._check_instrument, name, use, table, bodies))
        known = {n: (e.world_T_base, e.flange_T_tool) for n, e in entry.instruments.items()}
        try:
            alone = (entry.world_T_base, entry.flange_T_tool)
            hands = [n for n, some in tables.items() if some and all(t.kind == "sensor_points" for t in some)]
            worlds, tools = cell_frames(list(tables), known, alone, entry, hands)
        except InvalidInput as error:
            raise self._error(("instruments",), str(error)) from None
        return {
            name: InstrumentSource(found, entry.instruments.get(name), worlds[name], tools[name])
            for name, found in tables.items()
        }

    def _at_own_angles(
        self, poses: Poses, measurements: tuple[MeasuredTable, ...], instruments: dict[str, InstrumentSource]
    ) -> tuple[Poses, tuple[MeasuredTable, ...], dict[str, InstrumentSource]]:
        """Every reading at the joint angles that its row states, where they are not those of its pose."""
        known = {id(t): t for t in (*measurements, *(t for i in instruments.values() for t in i.tables or ()))}
        log, made = at_own_angles(poses, list(known.values()))
        if log is poses:
            return poses, measurements, instruments
        if self.entry.station is not None or self.entry.hand_eye is not None:
            raise self._error(
                ("poses",),
                "tables of measurements state other joint angles than those of their poses, which have images as well: "
                "give these readings poses of their own",
            )
        self.notes.append(f"readings at joint angles of their own: {len(log)} poses in place of {len(poses)}")
        new = dict(zip(known, made, strict=True))

        def at(tables: tuple[MeasuredTable, ...]) -> tuple[MeasuredTable, ...]:
            return tuple(new[id(t)] for t in tables)

        sources = {n: i if i.tables is None else replace(i, tables=at(i.tables)) for n, i in instruments.items()}
        return log, at(measurements), sources

    def _check_priors(self, robot: RobotModel) -> None:
        try:
            model_priors(self.entry.model.priors, robot)
        except InvalidInput as error:
            raise self._error(("model", "priors"), str(error)) from None

    def _check_instrument(
        self, name: str, use: InstrumentEntry, table: MeasuredTable, bodies: Mapping[str, BodySource]
    ) -> None:
        self._refuse(instrument_contradictions(name, use, table.kind, list(bodies)))
        if use.correction is not None:
            self.files.extend(module_file(use.correction, self.path.parent))

    def _error(self, place: tuple[str | int, ...], message: str) -> InvalidInput:
        line = self.document.line(place)
        return InvalidInput(f"{self.path}{f', line {line}' if line else ''}: {message}")

    def _refuse(self, found: Iterable[Contradiction]) -> None:
        faults = [str(self._error(place, message)) for place, message in found]
        if faults:
            raise InvalidInput(faults[0], faults)

    def _file(self, name: str) -> Path:
        path = self._place(name)
        self.files.append(path)
        return path

    def _place(self, name: str) -> Path:
        """A path as written in the file, relative to it; backslashes of another system are understood."""
        path = self.path.parent / name
        return self.path.parent / name.replace("\\", "/") if "\\" in name and not path.exists() else path

    def _hand_eye(self, poses: Poses | None) -> HandEyeSource | None:
        use = self.entry.hand_eye
        if use is None:
            return None
        source = self._source(use.camera, use.camera.calibration, ("hand_eye", "camera"), "the camera of 'hand_eye'")
        if use.camera.images is not None:
            source = replace(source, images=images_by_stem(source.images))
        if use.flange is None:
            return HandEyeSource(self._match_poses(source, use.camera.name, poses))
        poses, frames = read_flange_poses(self._place(use.flange))
        return HandEyeSource(self._match_poses(source, use.camera.name, poses), frames)

    def _flange_poses(self) -> Poses | None:
        use = self.entry.hand_eye
        return None if use is None or use.flange is None else read_flange_poses(self._file(use.flange))[0]

    def _robot(self) -> RobotModel | None:
        use = self.entry.robot
        if use is None:
            return None
        robot = read_any_robot(self._file(use.file), use.base_link, use.tip_link)
        loads = {name: load.payload() for name, load in self.entry.payloads.items()}
        own = sum(frame.mass for frame in robot.frames)
        for name, load in loads.items():
            if own > 0 and load.mass > 3.0 * own:
                self.warnings.append(
                    f"{self.path}: payload '{name}' of {load.mass:g} kg is {load.mass / own:.0f} times as heavy as the "
                    f"robot ({own:g} kg): check the unit, masses are in kg"
                )
        return replace(robot, payloads={**robot.payloads, **loads})

    def _body(self, name: str) -> BodySource:
        use = self.entry.bodies[name]
        file = read_body(self._file(use.targets))
        station = self.entry.station
        watched = station is not None and station.body == name and any(c.images for c in station.cameras.values())
        seen = self.entry.hand_eye
        watched |= seen is not None and seen.board == name and seen.camera.images is not None
        if watched or (use.survey is not None and use.survey.images):
            check_ring_codes(file)
        if use.survey is None:
            return BodySource(file)
        place = ("bodies", name, "survey")
        source = self._source(use.survey, use.survey.camera, place, f"the survey of '{name}'")
        return BodySource(file, _adjustable(source), use.survey)

    def _source(
        self, entry: SurveyEntry | StationCameraEntry, camera: str | None, place: tuple[str | int, ...], what: str
    ) -> ImageSource:
        if entry.tiles is not None and entry.images is None:
            raise self._error((*place, "tiles"), f"'tiles' of {what} needs 'images': a folder of lists of tiles")
        if (entry.images is None) == (entry.observations is None):
            raise self._error(place, f"{what} needs either 'images' (a folder) or 'observations' (a CSV file)")
        start, start_path = None, None
        if camera is not None:
            start, start_path = read_camera(self._place(camera)), split_choice(self._place(camera))[0]
            self.files.append(start_path)
        size = entry.size_px
        if start is not None:
            size = (start.camera.width, start.camera.height)
        if entry.observations is not None:
            marks = self._rows(TableUse(file=entry.observations), marks_of)
            check_marks(marks, size)
            return ImageSource({}, marks, start, start_path, size)
        folder = self._place(str(entry.images)).absolute()  # the report looks for them from anywhere
        if entry.tiles is None:
            return ImageSource(list_images(folder, what), None, start, start_path, size)
        reseau, files = read_reseau(self._place(entry.tiles))
        self.files.extend(files)
        whole = (reseau.shape[1], reseau.shape[0])
        if size not in (None, whole):
            where = start_path or self.path
            raise InvalidInput(
                f"{where}: {size[0] if size else 0} x {size[1] if size else 0} px, but the mosaic of "
                f"{files[0].name} has {whole[0]} x {whole[1]}: calibrate the "
                "mosaic itself, one pitch around the grid included"
            )
        return ImageSource(list_tiled(folder, what), None, start, start_path, whole, reseau, files)

    def _station(self, poses: Poses | None) -> dict[str, ImageSource]:
        station = self.entry.station
        if station is None:
            return {}
        if not station.cameras:
            raise self._error(("station", "cameras"), "the station has no cameras: name at least one")
        cameras = {}
        for name, use in station.cameras.items():
            source = self._part(partial(self._camera, name, use, poses))
            if source is not None:
                cameras[name] = source
        return cameras

    def _camera(self, name: str, use: StationCameraEntry, poses: Poses | None) -> ImageSource:
        source = self._source(use, use.calibration, ("station", "cameras", name), f"camera '{name}'")
        source = _adjustable(source)
        if use.images is not None:
            source = replace(source, images=images_by_stem(source.images))
        return self._match_poses(source, name, poses)

    def _match_poses(self, source: ImageSource, camera: str, poses: Poses | None) -> ImageSource:
        if poses is None:
            return source
        matched, warnings = match_poses(source, camera, poses, self.pose_names)
        self.warnings.extend(warnings)
        return matched

    def _check_targets(self, table: Table, found: MeasuredTable, bodies: Mapping[str, BodySource]) -> None:
        if found.kind not in ("points", "sensor_points") or not bodies or len(bodies) < len(self.entry.bodies):
            return
        listed = {t.id for body in bodies.values() for t in body.file.targets if t.id is not None}
        if any(body.survey is not None for body in bodies.values()):
            return
        known = [str(t) for t in sorted(listed)]
        strange = np.isin(table.rows, found.rows[~np.isin(found.target, list(listed))])

        def told(i: int) -> str:
            target = table.columns["target"][i]
            remedy = f"{proposal(target, known)}: add it there or remove the row"
            return f"target {target} is in no body of the campaign{remedy}"

        table.refuse(strange, told)


def _adjustable(source: ImageSource) -> ImageSource:
    """The source with start values that surveys and stations adjust, whatever the lens."""
    if source.start is None:
        return source
    return replace(source, start=replace(source.start, camera=adjustable(source.start.camera)))
