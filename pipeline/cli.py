"""Command line: thin commands that call the pipeline and turn errors into one line and an exit code.

Exit codes: 0 done, 1 the data cannot give a result, 2 wrong use.
"""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.cell_commands import cell
from pipeline.command_line import (
    INTERRUPTED,
    CampaignPath,
    InstrumentName,
    Json,
    Quiet,
    RunFolder,
    Workers,
    answers,
    wrong_use,
)
from pipeline.drift_commands import app as drift_app
from pipeline.fleet_commands import history, many
from pipeline.laser_sensor_commands import sensor
from pipeline.line_camera_commands import lines
from pipeline.live_commands import live_app
from pipeline.mastering_commands import mastering
from pipeline.messages import LOG, keep_libraries_silent
from pipeline.program_commands import programs

app = typer.Typer(
    name="pipeline",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="From photographs to an accurate robot: survey, measurement, identification, diagnosis, compensation.",
)
app.add_typer(cell, name="cell")
app.add_typer(drift_app, name="drift")
app.add_typer(mastering)
app.add_typer(programs)
app.add_typer(many)
app.add_typer(lines, name="lines")
app.add_typer(sensor, name="sensor")
app.add_typer(live_app)
app.add_typer(history, name="history")

RunOrDrift = Annotated[
    Path, typer.Argument(metavar="RUN", help="Run folder of a finished campaign, or state of a drift control.")
]
AtCycle = Annotated[int | None, typer.Option("--at-cycle", help="Of a drift control: the model of an earlier cycle.")]


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"robcal {version('robcal')}")
        raise typer.Exit


@app.callback()
def about(
    version: Annotated[
        bool, typer.Option("--version", help="Say the version and end.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """From photographs to an accurate robot: survey, measurement, identification, diagnosis, compensation."""


def _check_stages(start: str | None, until: str | None) -> None:
    from pipeline.runner import STAGE_NAMES
    from robcal.files.schemas import proposal

    for name in (until, start):
        if name is not None and name not in STAGE_NAMES:
            wrong_use(f"there is no stage '{name}'{proposal(name, list(STAGE_NAMES))}")
    if start and until and STAGE_NAMES.index(until) < STAGE_NAMES.index(start):
        wrong_use(f"stage '{until}' comes before '{start}': --until must not lie before --from")


def _summary(done: Any) -> dict[str, Any]:
    run = done.run
    return {"run": str(run.folder), "report": str(run.report), "ran": done.ran, "skipped": done.skipped} | {
        key: value for key, value in done.result.items() if key not in ("format", "notes")
    }


@app.command(short_help="All stages that the campaign has input for.")
def run(
    campaign: CampaignPath,
    out: Annotated[
        Path | None, typer.Option("--out", help="Run folder; default runs/<campaign name> beside the campaign.")
    ] = None,
    until: Annotated[str | None, typer.Option("--until", metavar="STAGE", help="Last stage to run.")] = None,
    start: Annotated[str | None, typer.Option("--from", metavar="STAGE", help="First stage to run again.")] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would run, from what, and about how long it takes; do nothing.")
    ] = False,
    workers: Workers = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Run all stages that the campaign has input for; resumes, and skips what is up to date.

    Stages: detect, survey, orient, measure, frames, identify, diagnose, verify, report.
    """
    with answers("run", as_json, quiet) as answer:
        _check_stages(start, until)
        if dry_run:
            from pipeline.dry_run import plan_data, plan_lines, plan_run

            answer.update(plan_data(*plan_run(campaign, out, until, start, workers)))
            for line in plan_lines(answer):
                LOG.info(line)
            return
        from pipeline.runner import run_campaign

        done = run_campaign(campaign, out, until=until, start=start, workers=workers)
        answer.update(_summary(done))
        LOG.info(f"results in {done.run.folder}")


@app.command(short_help="Write a campaign.yaml for what lies in a folder.")
def init(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the recordings.")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Look at what lies in a folder and write a commented campaign.yaml; one that is there is never overwritten."""
    with answers("init", as_json, quiet) as answer:
        from pipeline.beginning.writing import begin_campaign

        path, todo = begin_campaign(folder)
        answer.update({"campaign": str(path), "warnings": todo})
        for sentence in todo:
            LOG.warning(sentence)
        LOG.info(f"{path} written: look at it, then 'pipeline check {folder}'")


@app.command(short_help="All faults of a campaign at once, before any long work.")
def check(campaign: CampaignPath, quiet: Quiet = False, as_json: Json = False) -> None:
    """Look for everything that would stop a run, or is doubtful: a line each on standard output, with file and row.

    Exit code 1 if anything would stop a run. Reads all files and looks into a few images; writes nothing.
    """
    with answers("check", as_json, quiet) as answer:
        from pipeline.checking.check import check_campaign
        from pipeline.checking.told import as_data, as_lines

        found = check_campaign(campaign)
        answer.update(as_data(found))
        if not as_json:
            for line in as_lines(found, quiet):
                typer.echo(line)
        if found.faults:
            answer["ok"] = False
    if answer["faults"]:
        raise typer.Exit(1)


@app.command()
def survey(
    campaign: CampaignPath,
    body: Annotated[str | None, typer.Option("--body", help="Name of the body; default all with a survey.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Run folder; default runs/<campaign name> beside the campaign.")
    ] = None,
    workers: Workers = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Only the bundle adjustment of the campaign's bodies."""
    with answers("survey", as_json, quiet) as answer:
        from pipeline.commands import survey_campaign

        done = survey_campaign(campaign, body, out, workers)
        answer.update(_summary(done))
        LOG.info(f"results in {done.run.folder}")


@app.command(short_help="Only the diagnosis: what physics the model lacks.")
def diagnose(
    place: Annotated[Path, typer.Argument(metavar="CAMPAIGN_OR_RUN", help="Campaign folder or run folder.")],
    out: Annotated[Path | None, typer.Option("--out", help="Run folder, when a campaign is named.")] = None,
    workers: Workers = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Say what physics the model lacks: only the diagnosis (also a stage of `run`)."""
    with answers("diagnose", as_json, quiet) as answer:
        from pipeline.commands import diagnose_place

        done, diagnosis = diagnose_place(place, out, workers)
        answer.update({"run": str(done.run.folder), "diagnosis": diagnosis})
        for cause in diagnosis.get("causes", []):
            LOG.info(str(cause.get("statement") or cause.get("cause")))
        if not diagnosis.get("causes"):
            LOG.info("nothing missing: model and recordings agree within their noise")


@app.command(short_help="Where the calibrated robot's tool really is.")
def predict(
    run_folder: RunOrDrift,
    poses: Annotated[Path, typer.Option("--poses", help="Joint angles: pose, q1_deg, ... as in poses.csv.")],
    out: Annotated[Path, typer.Option("--out", help="Table of frames to write.")],
    nominal: Annotated[
        bool, typer.Option("--nominal", help="The uncalibrated robot after the best cell calibration.")
    ] = False,
    instrument: InstrumentName = None,
    at_cycle: AtCycle = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Say where the calibrated robot's tool really is, in the measuring system's coordinates."""
    with answers("predict", as_json, quiet) as answer:
        from pipeline.prediction import predict_run

        answer.update(predict_run(run_folder, poses, out, nominal=nominal, instrument=instrument, at_cycle=at_cycle))
        for sentence in answer["warnings"]:
            LOG.warning(sentence)
        LOG.info(f"{answer['poses']} frames in {out}")


@app.command(short_help="Commands that bring the tool where it should be.")
def compensate(
    run_folder: RunOrDrift,
    frames: Annotated[Path, typer.Option("--frames", help="Wanted tool frames; column payload if loads differ.")],
    out: Annotated[Path, typer.Option("--out", help="Table of joint angles (or targets) to write.")],
    kind: Annotated[str, typer.Option("--as", metavar="joints|frames", help="Joint angles, or targets F*.")] = "joints",
    system: Annotated[
        str, typer.Option("--in", metavar="world|base", help="Coordinates of the frames: measuring system or base.")
    ] = "world",
    program: Annotated[
        str | None,
        typer.Option("--program", metavar="krl|rapid|urscript", help="Write a program of that controller, no table."),
    ] = None,
    skip: Annotated[
        bool, typer.Option("--skip-unreachable", help="Leave out frames that the robot cannot reach.")
    ] = False,
    instrument: InstrumentName = None,
    at_cycle: AtCycle = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Find the commands that bring the real tool to the wanted frames."""
    if kind not in ("joints", "frames"):
        wrong_use(f"--as is 'joints' or 'frames', not '{kind}'")
    if system not in ("world", "base"):
        wrong_use(f"--in is 'world' or 'base', not '{system}'")
    if program not in (None, "krl", "rapid", "urscript"):
        wrong_use(f"--program is 'krl', 'rapid' or 'urscript', not '{program}'")
    with answers("compensate", as_json, quiet) as answer:
        from pipeline.prediction import CompensateOptions, compensate_run

        options = CompensateOptions(kind == "frames", system == "base", skip, program, instrument, at_cycle)
        answer.update(compensate_run(run_folder, frames, out, options))
        for sentence in answer["warnings"]:
            LOG.warning(sentence)
        remaining = answer["remaining_max_mm"]
        size = f"at most {remaining:.2g} mm" if remaining >= 1e-4 else "below 0.0001 mm"
        LOG.info(f"{answer['frames']} rows in {out}; residual of the model's inversion {size}, not the robot's error")


@app.command()
def report(
    run_folder: RunFolder,
    compare: Annotated[
        Path | None, typer.Option("--compare", metavar="RUN", help="Write what changed since this run as well.")
    ] = None,
    pdf: Annotated[bool, typer.Option("--pdf", help="Print it to report.pdf as well (needs Chromium).")] = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Write the report again."""
    with answers("report", as_json, quiet) as answer:
        from pipeline.commands import report_again

        for kind, path in report_again(run_folder, compare, pdf=pdf).items():
            answer[kind] = str(path)
            LOG.info(str(path))


@app.command(short_help="Render a small campaign and run it.")
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for the rendered campaign and its run.")] = Path("demo"),
    workers: Workers = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Render a small campaign and run it; the last line is the path of the report."""
    with answers("demo", as_json, quiet) as answer:
        from pipeline.commands import run_demo

        done = run_demo(out, workers)
        answer.update(_summary(done))
        if not as_json:
            typer.echo(str(done.run.report))


@app.command(short_help="Generate measuring poses for a campaign.")
def poses(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="YAML file of the format robcal/poses-1, or a run.")],
    out: Annotated[Path, typer.Option("--out", help="Table of poses to write.")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Generate measuring poses: within limits, visible, free of collisions, as few as the wanted accuracy needs."""
    with answers("poses", as_json, quiet) as answer:
        from pipeline.pose_generation import generate_poses

        answer.update(generate_poses(config, out))
        for sentence in answer["warnings"]:
            LOG.warning(sentence)
        LOG.info(f"{answer['poses']} poses in {out}")


@app.command(short_help="Sheets of targets to print; or what can be read in images of them.")
def targets(
    config: Annotated[
        Path | None, typer.Argument(metavar="CONFIG", help="What to print: YAML file of the format robcal/targets-1.")
    ] = None,
    images: Annotated[Path | None, typer.Option("--images", help="Folder of images to read targets in.")] = None,
    body: Annotated[Path | None, typer.Option("--body", help="With --images: body file of what is to be seen.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="PDF to write; with --images a folder.")] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Print targets: CONFIG --out sheet.pdf (a board, codes to cut out, a plate, a sphere), with its body file.

    Look at targets: --images FOLDER --out FOLDER writes a picture of what was read and refused in each image, and why,
    and a draft of the body file.
    """
    if (config is None) == (images is None) or out is None:
        wrong_use("state either CONFIG --out sheet.pdf, or --images FOLDER --out FOLDER")
    with answers("targets", as_json, quiet) as answer:
        if config is not None:
            from pipeline.sheets.sheets import make_sheet

            answer.update(make_sheet(config, out))
            LOG.info(f"{answer['targets']} targets on {out}, body file {answer['body']}")
        elif images is not None:
            from pipeline.sheets.reading import read_targets

            answer.update(read_targets(images, out, body))
            for row in answer["images"]:
                LOG.info(f"{row['image']}: {len(row['codes'])} identified, {row['dots']} dots without code")
            LOG.info(f"pictures in {out}" + (f", draft {answer['body']}" if "body" in answer else ""))


@app.command(short_help="C99 and URDF of the calibrated robot.")
def export(
    run_folder: RunOrDrift,
    c: Annotated[Path | None, typer.Option("--c", help="Folder for C99 source of the model and its inverse.")] = None,
    table: Annotated[
        Path | None, typer.Option("--table", help="Table of parameters for C source exported before (CSV).")
    ] = None,
    urdf: Annotated[Path | None, typer.Option("--urdf", help="URDF file of the calibrated robot.")] = None,
    kinematics: Annotated[
        Path | None, typer.Option("--ur-kinematics", help="Universal Robots' kinematics.yaml of the calibrated robot.")
    ] = None,
    data: Annotated[Path | None, typer.Option("--data", help="Folder for parameters as CSV and JSON.")] = None,
    ros: Annotated[Path | None, typer.Option("--ros", help="Folder for ROS: URDF, transforms, camera_info.")] = None,
    template: Annotated[
        Path | None,
        typer.Option("--template", help="URDF (its meshes stay) or kinematics.yaml the robot was read from."),
    ] = None,
    at_cycle: AtCycle = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Export the calibrated robot for controllers and simulators."""
    if all(path is None for path in (c, urdf, table, kinematics, data, ros)):
        wrong_use(
            "name what to write: --c FOLDER, --urdf FILE, --table FILE, --ur-kinematics FILE, --data or --ros FOLDER"
        )
    with answers("export", as_json, quiet) as answer:
        from pipeline.exports import Wanted, export_run

        written, notes = export_run(run_folder, Wanted(c, table, urdf, kinematics, data, ros, template), at_cycle)
        answer["files"] = [str(path) for path in written]
        answer["warnings"] = notes
        for sentence in notes:
            LOG.warning(sentence)
        for path in written:
            LOG.info(str(path))


def main() -> None:
    """Entry point of the console script."""
    keep_libraries_silent()
    try:
        app()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except BrokenPipeError:  # the reader of our output went away, as in `pipeline ... | head`
        sys.stderr.close()
        sys.exit(1)


if __name__ == "__main__":
    main()
