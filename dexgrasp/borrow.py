"""Arrays that are lent to compiled code for the length of a call."""

from typing import Any

from numba import types
from numba.core import cgutils
from numba.extending import intrinsic


def _borrowed(context: Any, loan: Any) -> Any:
    """Return an array, or each array of a tuple, as one that does not count who refers to it.

    Counting takes half the time of loops that call small functions with arrays. Lend a compiled function's arguments
    alone: its caller holds them until it returns, whereas local variables may go after their last mention.
    """

    def lend(target: Any, builder: Any, kind: Any, value: Any) -> Any:
        members = getattr(kind, "types", None)  # of a tuple
        if members is not None:
            parts = [lend(target, builder, part, builder.extract_value(value, k)) for k, part in enumerate(members)]
            return target.make_tuple(builder, kind, parts)
        if not isinstance(kind, types.Array):
            return value
        array = target.make_array(kind)(target, builder, value=value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()

    def codegen(target: Any, builder: Any, signature: Any, args: Any) -> Any:
        return lend(target, builder, loan, args[0])

    return loan(loan), codegen


borrowed: Any = intrinsic(_borrowed)
