"""Chapters: what was rejected, assumed and warned of; the files to use."""

from collections import Counter

from pipeline.report.blocks import Block, Bullets, Chapter, Text, table
from pipeline.report.material import Material, is_platform
from pipeline.report.style import number


def rejected_chapter(material: Material) -> Chapter:
    """Everything that was left out, with its reason."""
    blocks: list[Block] = []
    items: list[str] = []
    if material.frames is not None:
        items += [f"pose {material.pose_name(p.pose)}: {p.reason}" for p in material.frames.rejected_poses]
        items += [
            f"pose {material.pose_name(p.pose)}, target {p.target}: {p.reason}" for p in material.frames.rejected_points
        ]
    if material.identification is not None:
        rows, found = material.identification.rows, material.identification.robot
        items += [
            f"pose {material.pose_name(int(rows[i]))}: contradicts all others (normalised error "
            f"{found.normalised[i]:.1f}), left out of the identification"
            for i in found.outliers
        ]
    if material.diagnosis:
        items += [
            f"pose {p}: an observation is a gross error, left out of the diagnosis"
            for p in material.diagnosis.get("blunders", [])
        ]
    if material.station is not None:
        for mark in material.station.rejected:
            what = "whole image" if mark.target < 0 else f"target {mark.target}"
            items.append(f"camera {mark.camera}, pose {material.pose_name(mark.pose)}, {what}: {mark.reason}")
    for name, survey in material.surveys.items():
        items += [f"survey {name}, image {image}: not used: {reason}" for image, reason in survey.unused_images]
        items += [
            f"survey {name}, image {m.image}, target {m.target}: {m.reason} "
            f"(residual {m.residual[0]:+.2f}, {m.residual[1]:+.2f} px)"
            for m in survey.network.rejected
        ]
    if items:
        blocks.append(Bullets(tuple(items), f"Left out ({len(items)})"))
    elif material.stages:
        blocks.append(Text("Nothing was rejected."))
    told = tuple(f"{stage}: {note}" for stage, note in material.notes)
    if told:
        blocks.append(Bullets(told, "Warnings and notes"))
    index = material.detections
    if index is not None:
        empty = Counter(e.source for e in index.entries if e.targets == 0)
        if empty:
            blocks.append(Bullets(tuple(f"{s}: {n} images without a target" for s, n in empty.items()), "Empty images"))
    return Chapter("rejected", "What was rejected or assumed, and why", "", tuple(blocks))


_FILES = (
    ("robot_calibrated.yaml", "the calibrated robot: nominal chain, parameters, extra terms, base and tool"),
    ("covariance.npz", "covariance of its parameters"),
    ("diagnosis.json", "what the model left out, for programs"),
    ("result.json", "all figures of this report, for programs"),
    ("next_poses.csv", "poses that would tell apart what could not be told apart"),
    ("frames.csv", "measured poses with covariance"),
    ("points.csv", "measured points with covariance"),
    ("residuals.csv", "measured minus modelled, row by row"),
    ("log.txt", "what the program did"),
)


def files_chapter(material: Material) -> Chapter:
    """Files of the run and the commands that use them; timing."""
    run = material.run
    blocks: list[Block] = []
    if not material.stages:
        return Chapter("files", "Files", "", ())
    rows = [[name, what] for name, what in _FILES if (run.folder / name).is_file()]
    for folder, what in (("bodies", "surveyed coordinates with sigmas"), ("cameras", "calibrated camera")):
        rows += [[f"{folder}/{p.name}", what] for p in sorted((run.folder / folder).glob("*.yaml"))]
    blocks.append(table(["File", "What it is"], rows, text=(0, 1)))
    if run.robot.is_file():
        legs = is_platform(material)
        commanded = "leg lengths" if legs else "joint angles"
        commands = [
            ["pipeline compensate RUN --frames wanted.csv --out q.csv", f"{commanded} that bring the real tool there"],
            [
                "pipeline compensate RUN --frames wanted.csv --out targets.csv --as frames --in base",
                "corrected Cartesian targets, which most controllers load",
            ],
            ["pipeline export RUN --data out/", "parameters with their covariance, for programs"]
            if legs
            else ["pipeline export RUN --c controller/ --urdf robot.urdf", "C99 for the controller; geometry as URDF"],
            ["pipeline predict RUN --poses poses.csv --out frames.csv", "where the tool really is, with sigmas"],
        ]
        blocks.append(table(["Command", "Gives"], commands, "What to load into the controller.", text=(0, 1)))
    seconds = [[name, number(value)] for name, value in material.timing.items()]
    blocks.append(table(["Stage", "Seconds"], seconds, "Time of the stages."))
    return Chapter("files", "Files to use", f"In {run.folder}", tuple(blocks))
