"""Bundles: named tuples of arrays that one kernel passes to the next by address.

Numba passes a tuple of ten arrays as seventy numbers at each call, which takes half of all compiling. A bundle is
passed as one address. A field that is None is known to be None at compile time, so Numba leaves out every branch that
needs it:

    if batch.several is not None:
        ...  # not compiled for batches of one queue each
"""

from __future__ import annotations

import hashlib
from typing import Any, TypeVar, cast

import numba
from numba import extending, types
from numba.core import cgutils, datamodel
from numba.core.typing.templates import AttributeTemplate, infer_getattr

from bufgym.ground.kernel.arrays import local

Class = TypeVar("Class", bound=type)
_Type: Any = types.Type
_Template: Any = AttributeTemplate
_Model: Any = datamodel.models.PrimitiveModel
_extending: Any = extending


class BundleType(_Type):  # type: ignore[misc]  # Numba has no types
    """Numba's type of a bundle.

    ``instance_class`` is the named tuple, ``types`` has the type of each field. The name is short, as names of types
    are part of every name in the compiled code.
    """

    def __init__(self, instance_class: Any, kinds: tuple[Any, ...]) -> None:
        self.instance_class, self.types = instance_class, kinds
        told = hashlib.sha256(repr((instance_class._fields, kinds)).encode()).hexdigest()
        super().__init__(name=f"{instance_class.__name__}_{told[:8]}")

    @property
    def whole(self) -> Any:
        """Type of the same tuple by value."""
        return cast(Any, types).BaseTuple.from_types(self.types, self.instance_class)

    def kind_of(self, field: str) -> Any:
        """Type of ``field``, or None where there is no such field."""
        fields = self.instance_class._fields
        return self.types[fields.index(field)] if field in fields else None


def bundle(named_tuple: Class) -> Class:
    """Class decorator: kernels take this named tuple by its address."""
    _extending.typeof_impl.register(named_tuple)(_type_of)
    return named_tuple


def bundle_type(named_tuple: type, kinds: tuple[Any, ...]) -> Any:
    """Numba's type of a bundle whose fields have types ``kinds``."""
    return BundleType(named_tuple, kinds)


def _type_of(value: Any, _: Any) -> BundleType:
    return BundleType(type(value), tuple(cast(Any, numba).typeof(entry) for entry in value))


@cast(Any, datamodel).register_default(BundleType)
class _Address(_Model):  # type: ignore[misc]
    """A bundle in compiled code: the address of its fields."""

    def __init__(self, manager: Any, kind: BundleType) -> None:
        super().__init__(manager, kind, manager.lookup(kind.whole).get_value_type().as_pointer())


@infer_getattr
class _Fields(_Template):  # type: ignore[misc]
    """Types of the fields."""

    key = BundleType

    def generic_resolve(self, kind: BundleType, field: str) -> Any:
        return kind.kind_of(field)


def _field(context: Any, builder: Any, kind: BundleType, address: Any, field: str) -> Any:
    place = cast(Any, cgutils).gep_inbounds(builder, address, 0, kind.instance_class._fields.index(field))
    return builder.load(place)


def _from_python(kind: BundleType, value: Any, c: Any) -> Any:
    whole = c.unbox(kind.whole, value)
    address = cast(Any, cgutils).alloca_once_value(c.builder, whole.value)
    return _extending.NativeValue(address, is_error=whole.is_error, cleanup=whole.cleanup)


def _local_type(context: Any) -> Any:
    def local_type(given: Any) -> Any:
        if isinstance(given, BundleType):
            return given
        return BundleType(given.instance_class, tuple(cast(Any, types).unliteral(kind) for kind in given.types))

    return local_type


def _copied(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return cast(Any, cgutils).alloca_once_value(builder, builder.load(arguments[0]))


def _stored(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    value = context.cast(builder, arguments[0], signature.args[0], signature.return_type.whole)
    return cast(Any, cgutils).alloca_once_value(builder, value)


def teach() -> None:
    """Tell Numba."""
    _extending.type_callable(local)(_local_type)
    _extending.lower_builtin(local, BundleType)(_copied)
    _extending.lower_builtin(local, cast(Any, types).BaseNamedTuple)(_stored)
    _extending.lower_getattr_generic(BundleType)(_field)
    _extending.unbox(BundleType)(_from_python)
