"""Commands `batch`, `fleet` and `history`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from pipeline.command_line import Json, Quiet, answers, wrong_use
from pipeline.messages import LOG

many = typer.Typer()
history = typer.Typer(no_args_is_help=True, help="Runs with their provenance in a database, and what changed.")

Database = Annotated[
    str, typer.Option("--database", metavar="URL", help="SQLite file, or postgresql://user@host/name.")
]
DEFAULT = "runs/history.db"


@many.command(short_help="All campaigns of a folder, on all cores or a cluster.")
def batch(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder with campaigns, at any depth.")],
    out: Annotated[Path, typer.Option("--out", metavar="RUNS", help="Folder for the runs.")] = Path("runs"),
    workers: Annotated[int | None, typer.Option("--workers", min=1, max=1024, help="Processes; default all.")] = None,
    cluster: Annotated[
        str | None, typer.Option("--cluster", metavar="ADDRESS", help="Dask scheduler, as tcp://host:8786.")
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Run all campaigns of a folder; each resumes, and skips what is up to date."""
    if workers is not None and cluster is not None:
        wrong_use("--workers and --cluster exclude each other: the cluster has its own workers")
    with answers("batch", as_json, quiet) as answer:
        from pipeline.batch import run_batch

        answer.update(run_batch(folder, out, workers=workers, cluster=cluster))
        LOG.info(f"{answer['campaigns']} campaigns in {out}")


@many.command(short_help="What is usual among many robots, and which are not.")
def fleet(
    runs: Annotated[Path, typer.Argument(metavar="RUNS", help="Folder of runs, as `batch` writes it.")],
    out: Annotated[Path, typer.Option("--out", help="Page to write; the numbers go to fleet.json beside it.")],
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Compare the parameters of many calibrated robots: histograms, outlying robots, batches."""
    with answers("fleet", as_json, quiet) as answer:
        from pipeline.fleet import fleet_report

        answer.update(fleet_report(runs, out))
        for sentence in answer["warnings"]:
            LOG.warning(sentence)
        LOG.info(f"{answer['robots']} robots, out of the ordinary: {', '.join(answer['outlying']) or 'none'}; {out}")


@history.command("import")
def import_(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, or a folder of runs.")],
    database: Database = DEFAULT,
    robot: Annotated[str | None, typer.Option("--robot", help="Which robot; default the name in its file.")] = None,
    note: Annotated[str, typer.Option("--note", help="Something to remember.")] = "",
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Take a run into the history; once, however often it is imported."""
    with answers("history import", as_json, quiet) as answer:
        from pipeline.history import import_run

        answer.update(import_run(run, database, robot=robot, note=note))
        LOG.info(f"run {answer['id']} of {answer['robot']}" + ("" if answer["new"] else ": was there already"))


@history.command("list")
def list_(
    database: Database = DEFAULT,
    robot: Annotated[str | None, typer.Option("--robot", help="Only this robot's.")] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """All runs, the earliest measurement first."""
    with answers("history list", as_json, quiet) as answer:
        from pipeline.history import list_runs

        answer["runs"] = list_runs(database, robot)
        if not as_json:
            for row in answer["runs"]:
                mean = "" if row["mean_mm"] is None else f"{row['mean_mm']:.3f} mm"
                typer.echo(f"{row['id']:>4}  {row['measured_at'][:16]}  {row['robot']}  {row['campaign']}  {mean}")


@history.command()
def show(
    number: Annotated[str, typer.Argument(metavar="ID")],
    database: Database = DEFAULT,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Everything that is known of a run."""
    with answers("history show", as_json, quiet) as answer:
        from pipeline.history import show_run
        from robcal.files.yaml_io import yaml_text

        answer["run"] = show_run(database, number)
        if not as_json:
            typer.echo(yaml_text({k: v for k, v in answer["run"].items() if k != "parameters"}))


@history.command()
def compare(
    before: Annotated[str, typer.Argument(metavar="A", help="Number of a run, or a run folder.")],
    after: Annotated[str, typer.Argument(metavar="B")],
    database: Database = DEFAULT,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """What changed from A to B, with significance."""
    with answers("history compare", as_json, quiet) as answer:
        from pipeline.history import compare_runs

        answer.update(compare_runs(database, before, after))
        _tell(answer, as_json)


@history.command()
def changes(
    robot: Annotated[str, typer.Argument(metavar="ROBOT")],
    days: Annotated[float, typer.Option("--days", min=0.0, help="So long before the last run.")] = 365.0,
    database: Database = DEFAULT,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """What changed on a robot since last year (or --days), with significance."""
    with answers("history changes", as_json, quiet) as answer:
        from pipeline.history import changes_of

        answer.update(changes_of(database, robot, days))
        _tell(answer, as_json)


def _tell(answer: dict[str, Any], as_json: bool) -> None:
    for sentence in answer["warnings"]:
        LOG.warning(sentence)
    if not as_json:
        typer.echo(answer["statement"])
