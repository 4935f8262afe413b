"""Commands `pipeline lines ...`: systems of linear cameras and lights."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.command_line import Json, Quiet, answers
from pipeline.messages import LOG

lines = typer.Typer(no_args_is_help=True, help="Systems of linear cameras: calibration, and points of lights.")

Lines = Annotated[
    Path, typer.Argument(metavar="LINES", help="Readings: pose, target, camera, u_px, optional sigma_px.")
]


@lines.command("calibrate")
def calibrate_system(
    readings: Lines,
    places: Annotated[
        Path, typer.Option("--places", help="Known places of the lights: pose, target, x_mm, y_mm, z_mm, sigma_mm.")
    ],
    out: Annotated[Path, typer.Option("--out", help="File of the system to write.")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Calibrate three or more linear cameras from readings of lights at known places."""
    with answers("lines calibrate", as_json, quiet) as answer:
        from pipeline.line_cameras import calibrate_lines

        answer.update(calibrate_lines(readings, places, out))
        for row in answer["rejected_rows"]:
            LOG.warning(
                f"{readings}, row {row['row']}: camera '{row['camera']}' is {row['residual_px']:.3g} px off: left out"
            )
        LOG.info(
            f"{len(answer['cameras'])} cameras from {answer['places']} places in {out}: readings to "
            f"{answer['noise_px']:.3g} px, sigma0 {answer['sigma0']:.2f}, {answer['rejected']} readings left out"
        )


@lines.command("points")
def points(
    readings: Lines,
    system: Annotated[Path, typer.Option("--system", help="Calibrated system, from `lines calibrate`.")],
    out: Annotated[Path, typer.Option("--out", help="Table of points to write.")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Places of lights from the readings of a calibrated system, each with its covariance."""
    with answers("lines points", as_json, quiet) as answer:
        from pipeline.line_cameras import points_of_lines

        answer.update(points_of_lines(readings, system, out))
        for lost in answer["lost"][:5]:
            LOG.warning(f"target {lost['target']} of pose '{lost['pose']}': {lost['reason']}: left out")
        LOG.info(f"{answer['points']} points in {out}, sigma {answer['sigma_mm']:.3g} mm ({len(answer['lost'])} lost)")
