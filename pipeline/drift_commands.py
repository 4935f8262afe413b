"""Commands of the drift control: ``pipeline drift init | add | status | watch | rollback``."""

from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.command_line import Json, Quiet, answers
from pipeline.messages import LOG

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Keep a robot accurate while it warms up: a sensor in the hand looks at targets at rest.",
)

State = Annotated[
    str, typer.Argument(metavar="DRIFT", help="State: a file (SQLite), or postgresql://user@host/database.")
]


@app.command(short_help="Freeze the reference.")
def init(
    run_folder: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of the calibrated robot.")],
    readings: Annotated[Path, typer.Option("--readings", help="Readings of one tour or several: the reference.")],
    state: Annotated[str, typer.Option("--state", metavar="DRIFT", help="State to make: a file, or a URL.")],
    parameters: Annotated[
        str | None, typer.Option("--parameters", help="Drifting parameters, as axis2.x,axis3.pitch; default by rule.")
    ] = None,
    tool: Annotated[
        Path | None, typer.Option("--tool", help="YAML with flange_T_tool of the sensor, if RUN's tool is another.")
    ] = None,
    sigma_mm: Annotated[
        float, typer.Option("--sigma-mm", min=1e-5, help="Of a coordinate, where the readings state none.")
    ] = 0.02,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Freeze the reference: from here on, changes of what the sensor sees count as drift."""
    with answers("drift init", as_json, quiet) as answer:
        from pipeline.drift.actions import start
        from robcal.drift.reference import DriftSettings

        names = None if parameters is None else [name.strip() for name in parameters.split(",") if name.strip()]
        settings = DriftSettings(sigma=sigma_mm / 1000)
        answer.update(start(run_folder, readings, state, parameters=names, tool=tool, settings=settings))
        LOG.info(f"{state}: {answer['measurements']} measurements a tour, drifting: {', '.join(answer['parameters'])}")
        for sentence in answer["unwatched"]:
            LOG.warning(sentence)


@app.command(short_help="Take readings in.")
def add(
    state: State,
    readings: Annotated[list[Path], typer.Argument(metavar="READINGS", help="Tables of readings.")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Take readings in, each once; identify when a tour is complete, and put the new model in force."""
    with answers("drift add", as_json, quiet) as answer:
        from pipeline.drift.actions import add as take

        for file in readings:
            done = take(state, file)
            _tell(file, done)
            answer.update(_summed(answer, done))


@app.command(short_help="How the control stands.")
def status(
    state: State,
    page: Annotated[Path | None, typer.Option("--page", help="Write a page with the whole history (HTML).")] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Say which model is in force, how far the robot has drifted, and what needs attention."""
    with answers("drift status", as_json, quiet) as answer:
        from pipeline.drift.actions import status as stand

        answer.update(stand(state))
        if not as_json:
            typer.echo(_stand(answer))
        if page is not None:
            from pipeline.drift.page import write_page

            answer["page"] = str(write_page(state, page))
            LOG.info(str(page))


@app.command(short_help="Take in files that appear in a folder.")
def watch(
    state: State,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder in which tables of readings appear.")],
    every: Annotated[float, typer.Option("--every", min=0.1, help="Seconds between looks.")] = 2.0,
    once: Annotated[bool, typer.Option("--once", help="Take in what lies there, and end.")] = False,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Take in files as they appear in a folder, until stopped; a file that is refused is told and left alone."""
    with answers("drift watch", as_json, quiet) as answer:
        from pipeline.drift.actions import watch as look

        answer.update({"files": 0, "refused": []})
        for file, done in look(state, folder, every, once):
            if isinstance(done, str):
                LOG.warning(f"refused: {done}")
                answer["refused"].append(str(file))
                continue
            _tell(file, done)
            answer.update(_summed(answer, done), files=answer["files"] + 1)


@app.command(short_help="Put an earlier model in force.")
def rollback(
    state: State,
    to: Annotated[int, typer.Option("--to", metavar="VERSION", help="Version of the model.")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Put an earlier model in force; also takes the control up again after a jump."""
    with answers("drift rollback", as_json, quiet) as answer:
        from pipeline.drift.actions import rollback as back

        answer.update(back(state, to))
        LOG.info(f"model {to} of cycle {answer['of_cycle']} is in force")


def _tell(file: Path, done: dict[str, Any]) -> None:
    for alarm in done["alarms"]:
        LOG.warning(f"cycle {alarm['cycle']}: {alarm['kind']}: {alarm['text']}")
    LOG.info(
        f"{file}: {done['added']} readings taken in ({done['known']} known already), {done['models']} new models, "
        f"{done['missing']} measurements to the next"
    )


def _summed(answer: dict[str, Any], done: dict[str, Any]) -> dict[str, Any]:
    counts = ("readings", "added", "known", "tours", "models")
    total = {name: answer.get(name, 0) + done[name] for name in counts}
    return {**done, **total, "alarms": [*answer.get("alarms", []), *done["alarms"]]}


def _stand(answer: dict[str, Any]) -> str:
    lines = [f"cycle {answer['cycle']}, model {answer['model_version']}{', held' if answer['held'] else ''}"]
    if answer["corrected_mm"] is not None:
        lines.append(
            f"targets off by {answer['uncorrected_mm']:.3f} mm uncorrected, {answer['corrected_mm']:.3f} mm corrected"
        )
    for name, value in answer["parameters"].items():
        unit, factor = ("mm", 1e3) if name.rsplit(".", 1)[-1] in "xyz" else ("deg", 57.29577951308232)
        lines.append(f"{name:>16}  {factor * value:+9.4f} +- {factor * answer['sigma'][name]:.4f} {unit}")
    lines += answer["unwatched"]
    lines += [f"alarm at cycle {a['cycle']}: {a['kind']}: {a['text']}" for a in answer["alarms"][-10:]]
    return "\n".join(lines)
