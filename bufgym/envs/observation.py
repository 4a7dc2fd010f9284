"""The forms in which an observation is handed out, all of them views of the flat row of numbers that kernels write."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.observe import Field

Observation = Any
"""A dict of arrays, or for "flat" one array."""

FORMS = ("dict", "flat", "slots")
"""Names of the forms; ``ObservationForm`` says what each is."""


class ObservationForm:
    """What is observed of a queue of L = ``capacity`` messages, and how it is handed out.

    A row of numbers holds the slot fields, each with L + 1 entries and the newcomer's last, then the context fields.
    ``form`` is one of

    - "dict": an array for each field, [L + 1] or [1];
    - "flat": the row itself, as ``gymnasium.wrappers.FlattenObservation`` makes it of the dict;
    - "slots": ``slots`` [L + 1, slot fields] and ``context`` [context fields], as attention networks take them.

    Only the fields that are ``chosen`` by name are observed (None: all of them), in the order of the tables. With all
    of them nothing is copied. ``space`` is the Gymnasium space of one observation, ``numbers`` the length of a row.
    """

    def __init__(
        self,
        form: str,
        slot_fields: Sequence[Field],
        context_fields: Sequence[Field],
        capacity: int,
        chosen: Sequence[str] | None = None,
    ) -> None:
        if form not in FORMS:
            raise BufgymError(f"observation = {form!r}: must be one of {', '.join(map(repr, FORMS))}")
        fields = (*slot_fields, *context_fields)
        known = [field.name for field in fields]
        if isinstance(chosen, str):
            raise BufgymError(f"fields = {chosen!r}: must be a list of names; known: {', '.join(known)}")
        for name in chosen or ():
            if name not in known:
                raise BufgymError(f"fields: unknown field {name!r}; known: {', '.join(known)}")
        names = known if chosen is None else list(chosen)
        if not names:
            raise BufgymError("fields: choose at least one field to observe")
        self.form = form
        self._width = capacity + 1
        self._slot_fields = len(slot_fields)
        self._first_context = len(slot_fields) * self._width
        self.numbers = self._first_context + len(context_fields)
        self._fields = [(name, k) for k, name in enumerate(known) if name in names]
        slot_columns = [k for _, k in self._fields if k < self._slot_fields]
        context_columns = [k - self._slot_fields for _, k in self._fields if k >= self._slot_fields]
        numbers = [k * self._width + entry for k in slot_columns for entry in range(self._width)]
        numbers += [self._first_context + k for k in context_columns]
        everything = len(numbers) == self.numbers
        self._numbers = None if everything else np.array(numbers)
        self._columns = None if everything else (np.array(slot_columns, int), np.array(context_columns, int))
        self.space = self._space([fields[k] for _, k in self._fields])

    def split(self, rows: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Views of ``rows``, one row of numbers or n: slots [(n,) fields, L + 1] and context [(n,) fields]."""
        first, fields, width = self._first_context, self._slot_fields, self._width
        if rows.ndim == 1:
            return rows[:first].reshape(fields, width), rows[first:]
        return rows[:, :first].reshape(len(rows), fields, width), rows[:, first:]

    def of(self, rows: NDArray[np.float32]) -> Observation:
        """The observation of ``rows``, one row of numbers or n, in this form."""
        if self.form == "flat":
            return rows if self._numbers is None else rows.take(self._numbers, axis=-1)
        slots, context = self.split(rows)
        if self.form == "slots":
            if self._columns is not None:
                slots, context = slots.take(self._columns[0], axis=-2), context.take(self._columns[1], axis=-1)
            parts = {"slots": slots.swapaxes(-1, -2), "context": context}
            return {name: parts[name] for name in self.space}
        # Walked over with the fields' axis first, a view costs half of what an index costs.
        if rows.ndim > 1:
            slots, context = slots.swapaxes(0, 1), context.T
        arrays = [*slots, *context[..., np.newaxis]]
        return {name: arrays[k] for name, k in self._fields}

    def _space(self, fields: Sequence[Field]) -> Any:
        boxes = [_box([field], self._width if field.per == "slot" else 1) for field in fields]
        if self.form == "dict":
            # An OrderedDict keeps its order, of any other mapping Gymnasium sorts the keys: so to flatten it is "flat".
            return spaces.Dict(OrderedDict((field.name, box) for field, box in zip(fields, boxes, strict=True)))
        if self.form == "flat":
            return spaces.Box(np.concatenate([box.low for box in boxes]), np.concatenate([box.high for box in boxes]))
        per_slot, context = ([field for field in fields if field.per == per] for per in ("slot", "context"))
        parts = OrderedDict[str, Any]()
        if per_slot:
            box = _box(per_slot, 1)
            parts["slots"] = spaces.Box(np.tile(box.low, (self._width, 1)), np.tile(box.high, (self._width, 1)))
        if context:
            parts["context"] = _box(context, 1)
        return spaces.Dict(parts)


def _box(fields: Sequence[Field], entries: int) -> spaces.Box:
    """The bounds of so many entries of each of ``fields``, in one row."""
    low, high = (np.array([getattr(field, end) for field in fields], np.float32) for end in ("low", "high"))
    return spaces.Box(np.repeat(low, entries), np.repeat(high, entries))
