"""Commands `pipeline cell ...`: tool, objects, base and points of a calibrated robot's cell."""

from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.command_line import Json, Quiet, RunFolder, answers
from pipeline.messages import LOG

cell = typer.Typer(no_args_is_help=True, help="Tool, objects and base of the cell by touching, with uncertainties.")

Touched = Annotated[Path, typer.Argument(metavar="TOUCHES", help="Table: pose, q1_deg, ..., point, payload.")]
Out = Annotated[Path, typer.Option("--out", help="File to write.")]
Tool = Annotated[Path | None, typer.Option("--tool", help="Tool from `cell tcp`; default the tool of the run.")]
Noise = Annotated[
    float | None, typer.Option("--touch-mm", min=1e-4, max=100.0, help="Noise of a touch; default as they repeat.")
]


@cell.command()
def tcp(
    run: RunFolder, touches: Touched, out: Out, touch_mm: Noise = None, quiet: Quiet = False, as_json: Json = False
) -> None:
    """Tool from one fixed tip touched in several orientations; with points tip, x, xy its orientation as well."""
    with answers("cell tcp", as_json, quiet) as answer:
        from pipeline.cell import cell_tcp

        answer.update(cell_tcp(run, touches, out, touch_mm))
        _tell(answer, "flange_T_tool")


@cell.command("object")
def object_frame(
    run: RunFolder,
    touches: Touched,
    out: Out,
    nominal: Annotated[
        Path | None, typer.Option("--nominal", help="Coordinates in the object: point, x_mm, y_mm, z_mm, hold.")
    ] = None,
    tool: Tool = None,
    touch_mm: Noise = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Frame of an object from its points origin, x, xy, or from points with nominal coordinates."""
    with answers("cell object", as_json, quiet) as answer:
        from pipeline.cell import cell_object

        answer.update(cell_object(run, touches, out, nominal, tool, touch_mm))
        _tell(answer, "base_T_object")


@cell.command()
def measure(
    run: RunFolder,
    touches: Touched,
    out: Out,
    tool: Tool = None,
    touch_mm: Noise = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Places of touched points in base coordinates: the robot as measuring machine."""
    with answers("cell measure", as_json, quiet) as answer:
        from pipeline.cell import cell_measure

        answer.update(cell_measure(run, touches, out, tool, touch_mm))
        for sentence in answer["warnings"]:
            LOG.warning(sentence)
        LOG.info(f"{answer['points']} points in {out}, sigma at most {answer['sigma_max_mm']:.3g} mm")


@cell.command()
def base(
    run: RunFolder,
    pairs: Annotated[
        Path, typer.Argument(metavar="PAIRS", help="Table: pose, q1_deg, ..., and the measured frame x_mm ... yaw_deg.")
    ],
    out: Annotated[Path | None, typer.Option("--out", help="File to write.")] = None,
    tool: Tool = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Base in the measuring system from frames of the tool that are known there."""
    with answers("cell base", as_json, quiet) as answer:
        from pipeline.cell import cell_base

        answer.update(cell_base(run, pairs, out, tool))
        _tell(answer, "world_T_base")


@cell.command()
def probe(
    frames: Annotated[Path, typer.Argument(metavar="FRAMES", help="Measured frames of the probe, tip at rest.")],
    out: Out,
    touch_mm: Noise = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Tip of a probe held by hand, in the frame of its targets, from frames measured while it pivots."""
    with answers("cell probe", as_json, quiet) as answer:
        from pipeline.cell import cell_probe

        answer.update(cell_probe(frames, out, touch_mm))
        _tell(answer, "flange_T_tool")


def _tell(answer: dict[str, Any], key: str) -> None:
    for sentence in answer["warnings"]:
        LOG.warning(sentence)
    found = answer[key]
    xyz = ", ".join(f"{v:.3f} +- {s:.3f}" for v, s in zip(found["xyz_mm"], found["sigma_mm"], strict=True))
    rpy = ", ".join(f"{v:.4f} +- {s:.4f}" for v, s in zip(found["rpy_deg"], found["sigma_deg"], strict=True))
    LOG.info(f"{key}: xyz {xyz} mm, roll pitch yaw {rpy} deg, sigma0 {answer['sigma0']:.2f}")
