"""Kernels of models that differ in the values of their parameters only share one compiled graph."""

from collections import OrderedDict
from collections.abc import Hashable

import numpy as np

from robcal.robot.kernel import Kernel
from robcal.robot.model import RobotModel

MOST = 12
_KNOWN: OrderedDict[Hashable, Kernel] = OrderedDict()


def kernel_of(model: RobotModel, statics: str = "one_step") -> Kernel:
    """Kernel of a model, built anew only if none of its form was asked for lately.

    Raises what :class:`Kernel` raises. Weakness: kernels share buffers, so they are for one thread at a time.
    """
    form = _form(model, statics)
    if form in _KNOWN:
        _KNOWN.move_to_end(form)
    else:
        _KNOWN[form] = Kernel(model, statics)
        while len(_KNOWN) > MOST:
            _KNOWN.popitem(last=False)
    return _KNOWN[form].with_model(model)


def _form(model: RobotModel, statics: str) -> Hashable:
    """Everything that the graph depends on."""
    terms = tuple((t.name, t.frame, t.kind, t.expression, tuple(t.parameters)) for t in model.terms)
    gravity = tuple(np.asarray(model.gravity, dtype=float).tolist())
    return (model.frames, gravity, model.gravity_frame, terms, tuple(model.payloads.items()), statics)
