"""Commands `pipeline sensor ...`: laser sensors, calibrated by a moved target, and points of their raw readings."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from pipeline.command_line import Json, Quiet, answers
from pipeline.messages import LOG

sensor = typer.Typer(no_args_is_help=True, help="Laser sensors: calibration by a moved target, points of raw readings.")

READINGS = "point: u_px; section: u_px, v_px; spot: u_px, x_px, y_px; axial: distance_mm"


@sensor.command("calibrate")
def calibrate(
    table: Annotated[
        Path, typer.Argument(metavar="READINGS", help=f"Readings ({READINGS}) of a target at known x_mm, y_mm, z_mm.")
    ],
    kind: Annotated[Literal["point", "section", "spot", "axial"], typer.Option("--kind", help="Kind of the sensor.")],
    out: Annotated[Path, typer.Option("--out", help="File of the sensor to write.")],
    aim_mm: Annotated[
        float, typer.Option("--aim-mm", min=0.0, help="How far beside the target it may look where it does not tell.")
    ] = 0.0,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Calibrate a laser sensor from readings of a target that was moved to known places."""
    with answers("sensor calibrate", as_json, quiet) as answer:
        from pipeline.laser_sensors import calibrate_from

        answer.update(calibrate_from(table, kind, out, aim_mm))
        for row in answer["odd_rows"]:
            LOG.warning(f"{table}, row {row}: the reading is off by more than five standard deviations of all others")
        message = ", ".join(f"{name} to {value:.3g}" for name, value in answer["noise"].items())
        LOG.info(f"sensor of kind '{kind}' from {answer['places']} places in {out}: {message}")


@sensor.command("points")
def points(
    table: Annotated[Path, typer.Argument(metavar="READINGS", help=f"Raw readings: pose, target, and {READINGS}.")],
    file: Annotated[Path, typer.Option("--sensor", help="Calibrated sensor, from `sensor calibrate`.")],
    out: Annotated[Path, typer.Option("--out", help="Table of points in the sensor to write.")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Points in sensor coordinates from raw readings, each with its covariance."""
    with answers("sensor points", as_json, quiet) as answer:
        from pipeline.laser_sensors import points_from

        answer.update(points_from(table, file, out))
        LOG.info(f"{answer['points']} points in {out}, depth to {answer['sigma_mm']:.3g} mm")
