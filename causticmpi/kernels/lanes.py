"""Vector operations that numba has no words for, on rows of 16 lanes: to take rows of tables, and to pack lanes.

Plain LLVM, which makes AVX-512 of them where there is such, and loops elsewhere.
"""

from typing import Any

import numba
from llvmlite import ir

from causticmpi.kernels.jit import inline

_WORD, _LONG, _BIT = ir.IntType(32), ir.IntType(64), ir.IntType(1)
_COUNT = 16


def _vector(item: Any, count: int = _COUNT) -> Any:
    return ir.VectorType(item, count)


def _load(builder: Any, address: Any, kind: Any) -> Any:
    return builder.load(builder.inttoptr(address, kind.as_pointer()), align=4)


def _store(builder: Any, value: Any, address: Any) -> None:
    builder.store(value, builder.inttoptr(address, value.type.as_pointer()), align=4)


def _compressed(builder: Any, value: Any, mask: Any) -> Any:
    name = f"llvm.experimental.vector.compress.v{value.type.count}i{value.type.element.width}"
    function = builder.module.declare_intrinsic(
        name, (), ir.FunctionType(value.type, [value.type, mask.type, value.type])
    )
    return builder.call(function, [value, mask, ir.Constant(value.type, ir.Undefined)])


def _intrinsic(result: Any, generate: Any, arguments: int) -> Any:
    """An intrinsic of so many addresses or integers."""
    signature = result(*[numba.types.intp] * arguments)

    def build(context: Any, builder: Any, _: Any, values: Any) -> Any:
        found = generate(builder, *values)
        return context.get_dummy_value() if found is None else found

    typings = {
        1: lambda typingctx, a: (signature, build),
        2: lambda typingctx, a, b: (signature, build),
        3: lambda typingctx, a, b, c: (signature, build),
    }
    return numba.extending.intrinsic(typings[arguments])


def _marked_lanes(builder: Any, row: Any) -> Any:
    kind = _vector(_WORD)
    above = builder.icmp_signed(">", _load(builder, row, kind), ir.Constant(kind, [0] * _COUNT))
    return builder.zext(builder.bitcast(above, ir.IntType(_COUNT)), _LONG)


def _pack_words(builder: Any, row: Any, mask: Any, to: Any) -> None:
    bits = builder.bitcast(builder.trunc(mask, ir.IntType(_COUNT)), _vector(_BIT))
    _store(builder, _compressed(builder, _load(builder, row, _vector(_WORD)), bits), to)


def _pack_longs(builder: Any, row: Any, mask: Any, to: Any) -> None:
    half = _COUNT // 2
    for _ in range(2):
        low = builder.trunc(mask, ir.IntType(half))
        value = _load(builder, row, _vector(_LONG, half))
        _store(builder, _compressed(builder, value, builder.bitcast(low, _vector(_BIT, half))), to)
        row = builder.add(row, ir.Constant(_LONG, 8 * half))
        to = builder.add(to, builder.shl(builder.zext(builder.ctpop(low), _LONG), ir.Constant(_LONG, 3)))
        mask = builder.lshr(mask, ir.Constant(_LONG, half))


def _take_rows(width: int) -> Any:
    """16 rows of `width` (8 or 16) words, one a lane, turned into `width` rows of 16 lanes: a butterfly of shuffles,
    which swaps the number of a register with the number of a word, bit by bit."""

    def generate(builder: Any, table: Any, indices: Any, to: Any) -> None:
        row = _vector(_WORD, width)
        rows = []
        for lane in range(_COUNT):
            index = _load(builder, builder.add(indices, ir.Constant(_LONG, 4 * lane)), _WORD)
            offset = builder.mul(builder.zext(index, _LONG), ir.Constant(_LONG, 4 * width))
            rows.append(_load(builder, builder.add(table, offset), row))
        if width < _COUNT:
            both = ir.Constant(_vector(_WORD), list(range(_COUNT)))
            rows = [builder.shuffle_vector(rows[i], rows[i + width], both) for i in range(width)]
        bit = 1
        while bit < width:
            for i in range(width):
                if not i & bit:
                    a, b = rows[i], rows[i | bit]
                    first = [e if not e & bit else _COUNT + (e ^ bit) for e in range(_COUNT)]
                    second = [e ^ bit if not e & bit else _COUNT + e for e in range(_COUNT)]
                    rows[i], rows[i | bit] = (
                        builder.shuffle_vector(a, b, ir.Constant(_vector(_WORD), order)) for order in (first, second)
                    )
            bit <<= 1
        for i in range(width):
            _store(builder, rows[i], builder.add(to, ir.Constant(_LONG, 4 * _COUNT * i)))

    return generate


def _copy_words(builder: Any, row: Any, to: Any) -> None:
    _store(builder, _load(builder, row, _vector(_WORD)), to)


def _add_products(builder: Any, to: Any, row: Any, factor: Any) -> None:
    kind = _vector(_WORD)
    a, b = _load(builder, to, kind), _load(builder, row, kind)
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), builder.trunc(factor, _WORD), _WORD(0))
    factors = builder.shuffle_vector(one, one, ir.Constant(kind, [0] * _COUNT))
    none = ir.Constant(kind, [-1] * _COUNT)
    found = builder.add(a, builder.mul(b, factors))
    _store(builder, builder.select(builder.icmp_signed("==", b, none), none, found), to)


_add_product: Any = _intrinsic(numba.types.void, _add_products, 3)
_copy: Any = _intrinsic(numba.types.void, _copy_words, 2)
_marked: Any = _intrinsic(numba.types.intp, _marked_lanes, 1)
_count_bits: Any = _intrinsic(numba.types.intp, lambda builder, mask: builder.ctpop(mask), 1)
_first_bit: Any = _intrinsic(numba.types.intp, lambda builder, mask: builder.cttz(mask, _BIT(1)), 1)
_pack: Any = _intrinsic(numba.types.void, _pack_words, 3)
_pack_long: Any = _intrinsic(numba.types.void, _pack_longs, 3)
_take8: Any = _intrinsic(numba.types.void, _take_rows(8), 3)
_take16: Any = _intrinsic(numba.types.void, _take_rows(16), 3)


@inline
def marked(work, row):
    """The lanes whose word in a row is above zero, as the bits of a number."""
    return _marked(work.ctypes.data + 4 * row)


@inline
def count(mask):
    """How many lanes a mask has."""
    return _count_bits(mask)


@inline
def first(mask):
    """The first lane of a mask, which has any."""
    return _first_bit(mask)


@inline
def copy(source, word, target, to):
    """16 words of one array to another, at once."""
    _copy(source.ctypes.data + 4 * word, target.ctypes.data + 4 * to)


@inline
def add_product(work, row, by, factor):
    """Add to a row of int32 `factor` times another, `by`; where `by` is -1 it becomes -1."""
    _add_product(work.ctypes.data + 4 * row, work.ctypes.data + 4 * by, factor)


@inline
def pack(work, row, mask, queue, word):
    """The marked lanes of a row, side by side, to `queue` from a word on; what follows them there, up to 16 words in
    all, is lost."""
    _pack(work.ctypes.data + 4 * row, mask, queue.ctypes.data + 4 * word)


@inline
def pack_long(work, row, mask, queue, word):
    """The same of a row of 16 integers of 64 bits; `word` counts in 32 bits."""
    _pack_long(work.ctypes.data + 4 * row, mask, queue.ctypes.data + 4 * word)


@inline
def take8(table, work, indices, to):
    """Rows of a table (n, 8) of 32-bit words that the row `indices` of int32 names, column by column to 8 rows."""
    _take8(table.ctypes.data, work.ctypes.data + 4 * indices, work.ctypes.data + 4 * to)


@inline
def take16(table, work, indices, to):
    """The same of a table (n, 16), to 16 rows."""
    _take16(table.ctypes.data, work.ctypes.data + 4 * indices, work.ctypes.data + 4 * to)
