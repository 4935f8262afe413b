"""Which of the causes that were found the blocked folds confirm, and which of them the delivered robot has.

A search accepts causes one after the other; beside all that came later one of them may predict nothing any more at
poses that it was not fitted to. Such a cause is no name for anything: it is told as a remark.
"""

from collections.abc import Sequence
from dataclasses import replace

from robcal.calibration.joint_log import JointLog
from robcal.calibration.measurements import Rows
from robcal.diagnosis.core.fitting import Fit
from robcal.diagnosis.core.recording import Recording
from robcal.diagnosis.core.result import Diagnosis, Finding
from robcal.diagnosis.findings import at_fit
from robcal.diagnosis.noise.components import estimate_noise
from robcal.physics.cause import ObservationCause
from robcal.recipe.in_force import Folds, Form, InForce, contradicted
from robcal.recipe.order import of_order


def confirmed(
    diagnosis: Diagnosis, recording: Recording, log: JointLog, rows: Rows, extended: Form
) -> tuple[Diagnosis, Form]:
    """A diagnosis without the causes that folds contradict, which become remarks, and the form that is left.

    Parameters
    ----------
    recording, rows : the poses that it was found in, and their rows in the joint log.
    extended : the robot with everything that was found.
    """
    # what follows the order stays with the recording; curves with priors were accepted over folds, and share parts
    bound = {n for term in extended.model.terms if of_order(term) or term.priors for n in term.parameter_names}
    groups = {str(k): f.names for k, f in enumerate(diagnosis.findings) if f.names and not bound.issuperset(f.names)}
    if not groups:
        return diagnosis, extended
    folds = Folds(recording, log, rows)
    weak = contradicted(folds.delivery(extended, log), groups, folds.of_rows)
    if not weak:
        return diagnosis, extended
    form = extended.without([name for k in weak for name in groups[k]])
    noise = estimate_noise(form.model, recording, form.free, form.direct)
    final = form.fit(noise.apply(recording))
    size = len(final.free)
    stay = [f for k, f in enumerate(diagnosis.findings) if str(k) not in weak]
    remarks = [_remark(diagnosis.findings[int(k)]) for k in weak]
    if not stay:
        pattern = "an effect that blocked folds do not confirm"
        diagnosis = replace(diagnosis, unexplained_p=diagnosis.p_value, unexplained_pattern=pattern)
    return replace(
        diagnosis,
        findings=tuple(at_fit(finding, final) for finding in stay),
        model=final.model,
        free=final.free,
        covariance=final.covariance[:size, :size] * final.variance_factor,
        notes=(*diagnosis.notes, *remarks),
    ), replace(form, model=final.model, free=final.free, direct=_same(form, final))


def _same(form: Form, final: Fit) -> tuple:
    return tuple(item for item in final.accepted if any(item.cause is other.cause for other in form.direct))


def _remark(finding: Finding) -> str:
    return f"not confirmed on blocked folds, where poses are predicted no better with it: {finding.statement}"


def with_force(findings: Sequence[Finding], in_force: InForce, final: Fit) -> tuple[Finding, ...]:
    """Findings with the amplitudes that the robot in force has, or with why they are not in it.

    Parameters
    ----------
    final : the fit of the robot in force.
    """
    return tuple(_with_force(finding, in_force, final) for finding in findings)


def _with_force(finding: Finding, in_force: InForce, final: Fit) -> Finding:
    if finding.cause.kind.is_relabelling:
        return finding
    if isinstance(finding.cause, ObservationCause):
        if any(item.cause is finding.cause for item in in_force.form.direct):
            return at_fit(finding, final)
        return replace(finding, waits=in_force.measuring)
    waits = next((in_force.waits[name] for name in finding.names if name in in_force.waits), "")
    return replace(finding, waits=waits) if waits else at_fit(finding, final)


def unlike_table(findings: Sequence[Finding]) -> list[str]:
    """Findings whose sentence quotes other numbers than their parameters."""
    return [
        f"the sentence '{finding.statement}' does not quote its parameters"
        for finding in findings
        if finding.cause.describe(finding.parameters) not in finding.statement
    ]
