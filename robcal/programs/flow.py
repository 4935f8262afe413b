"""Which tool and base are in force where: a program's statements followed along all ways that it can take.

Some languages set tool and base by statements of their own and have motions that use what was set last. The statements
are walked through block by block: after branches the states of all of them are merged, loops are repeated until nothing
changes, routines of the file are entered where they are called, and a label may be reached from each jump to it. Where
two ways bring different frames, the frame is unclear.

Weakness: routines of other files are taken to leave tool and base as they found them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from robcal.programs.targets import FrameOf, Unclear

DEEPEST = 12
"""Calls within calls that are followed; deeper ones recur."""


@dataclass(frozen=True)
class Active:
    """Tool and base in force; ``outer`` is a reason why motions would not be in base coordinates, if there is one."""

    tool: FrameOf
    base: FrameOf
    outer: str | None = None

    def merged(self, other: "Active | None") -> "Active":
        """What is known where either this state or the other may be in force."""
        if other is None or other == self:
            return self
        return Active(_one(self.tool, other.tool), _one(self.base, other.base), self.outer or other.outer)


def _one(a: FrameOf, b: FrameOf) -> FrameOf:
    if a == b:
        return a
    return Unclear("differs between the ways on which the program comes here")


@dataclass(frozen=True)
class Step:
    """A statement that matters: kind 'set', 'move', 'call', 'jump', 'label', 'branch' or 'loop'.

    Attributes
    ----------
    name : routine or label; index : of a motion, in the reader's own list.
    tool, base, outer : what a 'set' sets (None leaves it).
    blocks : bodies of a branch or loop. complete : a branch with an 'else'.
    """

    kind: str
    name: str = ""
    index: int = -1
    tool: FrameOf | None = None
    base: FrameOf | None = None
    outer: str | None = None
    blocks: tuple[tuple["Step", ...], ...] = ()
    complete: bool = False


@dataclass
class Flow:
    """Walk through the routines of a file; ``at`` then holds the state of every motion by its index."""

    routines: dict[str, tuple[Step, ...]]
    start: Active
    at: dict[int, Active] = field(default_factory=dict)
    _jumps: dict[str, Active] = field(default_factory=dict)
    _ends: dict[tuple[str, Active], Active] = field(default_factory=dict)

    def walk(self, entries: Sequence[str]) -> dict[int, Active]:
        """States of all motions that the given routines and those that they call contain."""
        for _ in range(3):  # jumps back need the states of a walk before
            self._ends.clear()
            for name in entries:
                self._run(self.routines[name], self.start, 0, name)
        return self.at

    def _run(self, steps: Sequence[Step], state: Active, depth: int, routine: str) -> Active:
        for step in steps:
            state = self._step(step, state, depth, routine)
        return state

    def _step(self, step: Step, state: Active, depth: int, routine: str) -> Active:
        label = f"{routine}:{step.name}"
        if step.kind == "set":
            state = replace(state, tool=step.tool or state.tool, base=step.base or state.base)
            return state if step.outer is None else replace(state, outer=step.outer or None)
        if step.kind == "move":
            self.at[step.index] = state.merged(self.at.get(step.index))
        elif step.kind == "call" and step.name in self.routines and depth < DEEPEST:
            key = step.name, state
            if key not in self._ends:  # each routine once for what is in force: calls within calls would multiply
                self._ends[key] = state  # what a call of itself leaves, as far as it is followed
                self._ends[key] = self._run(self.routines[step.name], state, depth + 1, step.name)
            return self._ends[key]
        elif step.kind == "jump":
            self._jumps[label] = state.merged(self._jumps.get(label))
        elif step.kind == "label":
            return state.merged(self._jumps.get(label))
        elif step.kind == "branch":
            ends = [self._run(block, state, depth, routine) for block in step.blocks]
            return _merged(ends if step.complete else [state, *ends])
        elif step.kind == "loop":
            for _ in range(3):
                again = state.merged(self._run(step.blocks[0], state, depth, routine))
                if again == state:
                    break
                state = again
        return state


def _merged(states: Sequence[Active]) -> Active:
    merged = states[0]
    for state in states[1:]:
        merged = merged.merged(state)
    return merged


@dataclass
class Blocks:
    """Builds the nested steps of routines from statements in the order of the text."""

    routines: dict[str, list[Step]] = field(default_factory=dict)
    called: set[str] = field(default_factory=set)
    _open: list[tuple[str, list[list[Step]], bool]] = field(default_factory=list)
    _current: list[list[Step]] = field(default_factory=list)

    def routine(self, name: str) -> None:
        """A routine begins; what was open before is closed where it ends."""
        self.routines[name] = []
        self._current.append(self.routines[name])

    def end_routine(self) -> None:
        """The innermost routine ends."""
        if len(self._current) > 1:
            self._current.pop()

    def add(self, step: Step) -> None:
        """A step in the innermost open block."""
        if step.kind == "call":
            self.called.add(step.name)
        self._innermost().append(step)

    def open(self, kind: str) -> None:
        """A 'branch' or 'loop' begins with its first block; a 'function' or 'thread' is opened by :meth:`routine`."""
        self._open.append((kind, [[]], False))
        self._current.append(self._open[-1][1][0])

    def next_block(self, last: bool = False) -> None:
        """Another block of the innermost branch; ``last`` for an else."""
        if not self._open:
            return
        kind, blocks, complete = self._open[-1]
        blocks.append([])
        self._current[-1] = blocks[-1]
        self._open[-1] = (kind, blocks, complete or last)

    def close(self) -> None:
        """The innermost branch or loop ends."""
        if not self._open:
            return
        kind, blocks, complete = self._open.pop()
        self._current.pop()
        self._innermost().append(Step(kind, blocks=tuple(tuple(b) for b in blocks), complete=complete))

    def entries(self) -> list[str]:
        """Routines that nothing in the file calls, and the first one."""
        names = list(self.routines)
        return [n for i, n in enumerate(names) if i == 0 or n not in self.called]

    def _innermost(self) -> list[Step]:
        if not self._current:
            self.routine("")
        return self._current[-1]
