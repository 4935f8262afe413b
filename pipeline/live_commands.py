"""Command `pipeline live`."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.command_line import Json, Quiet, answers
from pipeline.messages import LOG

live_app = typer.Typer()


@live_app.command(short_help="Drive a robot through poses and measure them, over TCP.")
def live(
    poses: Annotated[Path, typer.Argument(metavar="POSES", help="Joint angles to measure, as `poses` writes them.")],
    robot: Annotated[Path, typer.Option("--robot", help="Nominal robot; its limits are kept.")],
    controller: Annotated[str, typer.Option("--controller", metavar="HOST:PORT", help="Program on the controller.")],
    out: Annotated[Path, typer.Option("--out", metavar="CAMPAIGN", help="Campaign folder to write.")],
    sensor: Annotated[
        str | None, typer.Option("--sensor", metavar="HOST:PORT", help="Measuring system; default the controller.")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Send poses to a controller, wait until the robot stands, measure, and write a campaign; resumes."""
    with answers("live", as_json, quiet) as answer:
        from pipeline.live.session import measure_live

        answer.update(measure_live(poses, robot, out, controller, sensor))
        LOG.info(f"{answer['poses']} poses measured: pipeline run {out}")
