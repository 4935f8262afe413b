"""Command export: the calibrated robot as C99 source and as URDF."""

from pathlib import Path

from pipeline.robot_in_force import robot_in_force
from robcal.files.storage import write_text
from robcal.files.tables import write_table
from robcal.robot.export.c_export import export_c, parameter_table
from robcal.robot.export.urdf import urdf_text


def export_run(
    folder: Path, c: Path | None, urdf: Path | None, table: Path | None = None, at_cycle: int | None = None
) -> list[Path]:
    """Write the wanted exports; returns the files.

    Raises
    ------
    InvalidInput : no calibrated robot in the run, or a model that has no counterpart in the format.
    """
    calibrated = robot_in_force(folder, at_cycle)
    written: list[Path] = []
    if c is not None:
        source = export_c(calibrated.model, statics=calibrated.statics, defaults=calibrated.defaults)
        for name, text in ((source.header_name, source.header), (source.source_name, source.source)):
            write_text(c / name, text)
            written.append(c / name)
    if table is not None:
        values = parameter_table(calibrated.model)
        write_table(table, {"parameter": list(values), "value": [repr(v) for v in values.values()]})
        written.append(table)
    if urdf is not None:
        write_text(urdf, urdf_text(calibrated.model))
        written.append(urdf)
    return written
