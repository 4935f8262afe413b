"""Command `pipeline program`."""

from pathlib import Path
from typing import Annotated

import typer

from pipeline.command_line import InstrumentName, Json, Quiet, answers
from pipeline.messages import LOG

programs = typer.Typer()

Frames = list[str] | None


@programs.command(short_help="A controller's program with its targets corrected.")
def program(
    run_folder: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run folder of a finished campaign, or state of a drift control.")
    ],
    path: Annotated[Path, typer.Argument(metavar="PROGRAM", help="KUKA .src, ABB .mod, UR .script or Fanuc .ls.")],
    out: Annotated[Path, typer.Option("--out", help="Corrected program to write; of KRL also its .dat beside it.")],
    tool: Annotated[
        Frames, typer.Option("--tool", metavar="NAME=FILE", help="A tool that the program only names, from `cell tcp`.")
    ] = None,
    base: Annotated[
        Frames, typer.Option("--base", metavar="NAME=FILE", help="A base that it only names, from `cell object`.")
    ] = None,
    robot_base: Annotated[
        bool, typer.Option("--robot-base", help="Bases that the program does not state are the robot's own.")
    ] = False,
    dialect: Annotated[
        str | None, typer.Option("--dialect", metavar="krl|rapid|urscript|fanuc", help="Default: by the suffix.")
    ] = None,
    payload: Annotated[str | None, typer.Option("--payload", metavar="NAME", help="What the robot carries.")] = None,
    instrument: InstrumentName = None,
    at_cycle: Annotated[
        int | None, typer.Option("--at-cycle", help="Of a drift control: the model of an earlier cycle.")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Correct every target of a program for the calibrated robot, in place; all else stays byte for byte."""
    with answers("program", as_json, quiet) as answer:
        from pipeline.programs import correct_program

        answer.update(
            correct_program(
                run_folder,
                path,
                out,
                tools=tool or (),
                bases=base or (),
                robot_base=robot_base,
                dialect=dialect,
                payload=payload,
                instrument=instrument,
                at_cycle=at_cycle,
            )
        )
        for sentence in answer["warnings"]:
            LOG.warning(sentence)
        LOG.info(
            f"{answer['targets']} targets corrected in {', '.join(answer['out'])}: the tool would be off by "
            f"{answer['uncorrected_mean_mm']:.3f} mm on average, {answer['uncorrected_max_mm']:.3f} mm at most"
        )
