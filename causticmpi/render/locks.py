"""Locks on parts of an array that several processes add to: a word each, in memory that they share.

Taking one is a single instruction and never waits: who finds a part taken turns to another one first. What was written
under a lock is seen by whoever takes it next (acquire, release), on any processor.
"""

from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils

FREE, TAKEN = 0, 1


def _word(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """Address of locks[i]."""
    kind = signature.args[0]
    locks = context.make_array(kind)(context, builder, arguments[0])
    index = context.cast(builder, arguments[1], signature.args[1], numba.types.intp)
    return cgutils.get_item_pointer(context, builder, kind, locks, [index], wraparound=False)


def _try_to_take(typingctx: Any, locks: Any, i: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = _word(context, builder, signature, arguments)
        before = builder.atomic_rmw("xchg", word, ir.Constant(ir.IntType(32), TAKEN), "acquire")
        return builder.icmp_signed("==", before, ir.Constant(ir.IntType(32), FREE))

    return numba.types.boolean(locks, i), generate


def _give_back(typingctx: Any, locks: Any, i: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = _word(context, builder, signature, arguments)
        builder.atomic_rmw("xchg", word, ir.Constant(ir.IntType(32), FREE), "release")
        return context.get_dummy_value()

    return numba.types.void(locks, i), generate


try_to_take: Any = numba.extending.intrinsic(_try_to_take)
"""try_to_take(locks, i): take lock i of an int32 array, from within a kernel; False if another holds it."""
give_back: Any = numba.extending.intrinsic(_give_back)
"""give_back(locks, i): free lock i, which the caller holds."""
