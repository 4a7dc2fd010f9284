"""Forms of an observation; each is a view of the flat row of numbers that kernels write."""

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bufgym.model.observe import BUILT_IN, OWN_FIELDS, Field, chosen_at, own_field
from bufgym.utils.errors import BufgymError, unknown

Observation = Any
"""A dict of arrays; for "flat", one array."""


class Place(NamedTuple):
    """Place of a field in a row of numbers.

    Fields:
        field: the field.
        first: index of its first number.
        entries: count of its numbers.
    """

    field: Field
    first: int
    entries: int


class ObservationForm:
    """The observed fields of a queue of L = ``capacity`` messages, and the form of the observation.

    A row of numbers first holds the fields of the tables (``table_numbers``): slot fields with L + 1 entries each, the
    newcomer's last, or candidate fields with k + 1 entries each, the head's last; then context fields. Other chosen
    fields follow at ``places``. Where ``only_chosen``, a row holds the chosen fields alone.

    ``form`` is "dict", an array for each field, [L + 1], [k + 1] or [1]; or "flat", the row itself, equal to the dict
    under ``gymnasium.wrappers.FlattenObservation``.

    Only fields named in ``chosen`` are observed, by default all of the tables. They keep the order of the tables, slots
    before the context, and other fields come last in each. Candidate fields and their context are always observed, and
    named fields follow.

    ``has_slots`` says whether rows hold slot fields of the tables. Where ``is_row``, an observation is the row itself.
    ``named`` are the built-in fields that are observed only because they are named; None if there are none, and the row
    holds tables. ``own_places`` are the places of your own fields. ``space`` is the Gymnasium space of one observation,
    ``numbers`` the length of a row. ``candidates`` is k.
    """

    def __init__(
        self,
        form: str,
        slot_fields: Sequence[Field],
        context_fields: Sequence[Field],
        capacity: int,
        chosen: Sequence[str] | None = None,
        *,
        candidates: int = 0,
        only_chosen: bool = False,
    ) -> None:
        known = {field.name: field for field in (*slot_fields, *context_fields)}
        others: dict[str, Field] = {}
        names = [*known] if chosen is None or candidates else []
        names += chosen or ()
        for k, name in enumerate(names):
            if name not in known:
                found = BUILT_IN.get(name) or own_field(name)
                if found is None:
                    raise unknown("field", name, list({**known, **BUILT_IN, **OWN_FIELDS}), place="fields")
                others[found.name], names[k] = found, found.name
        if not names:
            raise BufgymError("fields: choose at least one field to observe")
        self.form, self.has_slots = form, bool(slot_fields) and not only_chosen
        widths = {"slot": capacity + 1, "candidate": candidates + 1, "context": 1}
        self._width = widths["candidate" if candidates else "slot"]
        self._slot_fields, self._context_fields = len(slot_fields), len(context_fields)
        self._first_context = self._slot_fields * self._width
        self.table_numbers = 0 if only_chosen else self._first_context + self._context_fields
        of_tables = {} if only_chosen else dict(zip(known, _firsts(known.values(), widths), strict=True))
        fields = [*(field for name, field in known.items() if name in names), *others.values()]
        if candidates:
            fields.sort(key=lambda field: (field.name in others, field.per == "context"))
        else:
            fields.sort(key=lambda field: field.per == "context")
        self.places: list[Place] = []
        self.numbers = self.table_numbers
        for field in fields:
            first, entries = of_tables.get(field.name, self.numbers), widths[field.per]
            self.places.append(Place(field, first, entries))
            self.numbers = max(self.numbers, first + entries)
        numbers = np.concatenate([np.arange(place.first, place.first + place.entries) for place in self.places])
        everything = np.array_equal(numbers, np.arange(self.numbers))
        self.is_row = form == "flat" and everything
        self._numbers = None if everything else numbers
        beside = [place for place in self.places if place.first >= self.table_numbers]
        built_in = [place for place in beside if place.field in BUILT_IN.values()]
        firsts = {place.field.name: place.first for place in built_in}
        self.named = chosen_at(firsts) if only_chosen or built_in else None
        self.own_places = [place for place in beside if place not in built_in]
        low, high = np.zeros((2, self.numbers), np.float32)
        for field, first, entries in self.places:
            low[first : first + entries], high[first : first + entries] = field.low, field.high
        self.space: Any = _space(self.of(low), self.of(high))
        if form == "flat":  # numbers have no names, so the space has them, and takes them into a model's file
            self.space.fields = {place.field.name: place.entries for place in self.places}

    def split(self, rows: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Split ``rows`` (one row or n) into views: slots [(n,) fields, L + 1] and context [(n,) fields]."""
        first, end, fields, width = self._first_context, self.table_numbers, self._slot_fields, self._width
        return rows[..., :first].reshape(*rows.shape[:-1], fields, width), rows[..., first:end]

    def of(self, rows: NDArray[np.float32]) -> Observation:
        """The observation of ``rows``, one row of numbers or n, in this form."""
        if self.form == "dict":
            return {place.field.name: rows[..., place.first : place.first + place.entries] for place in self.places}
        return rows if self._numbers is None else rows.take(self._numbers, axis=-1)


def fields_of(space: Any) -> dict[str, int] | None:
    """The fields that a space names, "dict" or "flat", with the count of each one's numbers; None if it names none."""
    if isinstance(space, spaces.Dict):
        return {name: spaces.flatdim(part) for name, part in space.items()}
    return getattr(space, "fields", None)


def _firsts(fields: Iterable[Field], widths: Mapping[str, int]) -> Iterator[int]:
    """Index of each field's first number in a row of all of them."""
    first = 0
    for field in fields:
        yield first
        first += widths[field.per]


def _space(low: Observation, high: Observation) -> Any:
    """The space of observations between these two."""
    if not isinstance(low, dict):
        return spaces.Box(low, high)
    # Gymnasium sorts the keys of any mapping but an OrderedDict, and so would flatten in another order.
    return spaces.Dict(OrderedDict((name, spaces.Box(low[name], high[name])) for name in low))
