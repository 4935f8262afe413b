"""Errors the library raises on purpose. The class says what kind, the message which row or parameter and the remedy."""

from collections.abc import Iterable


class RobcalError(Exception):
    """Base of all errors raised on purpose; its text is fit to be shown to a user."""


class InvalidInput(RobcalError):
    """Data or settings that contradict their format: a NaN, a wrong unit, an unknown name.

    Attributes
    ----------
    faults : a sentence for each fault, where a reader found several at once; the error's text is the first.
    """

    def __init__(self, message: str, faults: Iterable[str] = ()) -> None:
        super().__init__(message)
        self.faults: tuple[str, ...] = tuple(faults) or (message,)


class DegenerateGeometry(RobcalError):
    """The data are well formed but their geometry carries no solution (for example collinear targets)."""


class NotIdentifiable(RobcalError):
    """Parameters that the data cannot tell apart.

    Attributes
    ----------
    parameters : names of the parameters concerned.
    """

    def __init__(self, message: str, parameters: Iterable[str] = ()) -> None:
        super().__init__(message)
        self.parameters: tuple[str, ...] = tuple(parameters)


def located(error: RobcalError, where: str) -> RobcalError:
    """The same error with the place in front of its message."""
    if isinstance(error, NotIdentifiable):
        return NotIdentifiable(f"{where}: {error}", error.parameters)
    if isinstance(error, InvalidInput):
        return InvalidInput(f"{where}: {error}")
    return DegenerateGeometry(f"{where}: {error}") if isinstance(error, DegenerateGeometry) else error
