"""The one place that holds the compile policy and the place of the compiled code on disk.

fastmath without `nnan` and `ninf`: with them LLVM may assume that NaN never happens, and the guard that counts
non-finite samples would compile to nothing. `error_model="numpy"` drops the zero-division checks of Python.

numba keys its disk cache by the file of a kernel alone, not by the kernels it calls. The folder therefore carries a
hash of every kernel source that samples depend on, so that an edited or upgraded installation never runs stale code.
Kernels elsewhere (of meshes, `inspect` and `bench`) call none outside these rooms and their own file.
"""

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parents[1]
KERNEL_ROOMS = ("kernels", "preprocess", "estimators", "render")


def source_hash() -> str:
    """16 hex digits of every source that samples depend on; those of the scene show in the hash of its arrays."""
    digest = hashlib.sha256()
    for room in KERNEL_ROOMS:
        for source in sorted((PACKAGE / room).glob("*.py")):
            digest.update(source.name.encode())
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def cache_directory() -> Path:
    """Folder of the compiled kernels: $CAUSTICMPI_CACHE, else the user's cache, else a temporary folder."""
    base = os.environ.get("CAUSTICMPI_CACHE")
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    candidates = [Path(base)] if base else []
    candidates += [Path(home) / "causticmpi", Path(tempfile.gettempdir()) / f"causticmpi-{os.getuid()}"]
    name = source_hash()
    for candidate in candidates:
        if _writable(candidate / name):
            return candidate / name
    return candidates[-1] / name


if "NUMBA_CACHE_DIR" not in os.environ:
    os.environ["NUMBA_CACHE_DIR"] = str(cache_directory())
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import numba  # noqa: E402
from llvmlite import ir  # noqa: E402

# numba reads its environment when it is first imported, which may have been before this module.
numba_config: Any = numba.config
numba_config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"]

_njit: Any = numba.njit  # its stubs do not know `_nrt`
_register: Any = numba.extending.register_jitable
POLICY: dict[str, Any] = {
    "fastmath": {"nsz", "arcp", "contract", "afn", "reassoc"},
    "error_model": "numpy",
    "_nrt": False,
}


def kernel(function: Callable[..., Any]) -> Any:
    """Compile for the machine at hand, cached on disk.

    `_nrt=False`: kernels allocate nothing and count no references; workspace is handed in.
    """
    return _njit(cache=True, no_cfunc_wrapper=True, **POLICY)(function)


def exact_kernel(function: Callable[..., Any]) -> Any:
    """A kernel whose +, -, *, / and sqrt are rounded as IEEE 754 has it: the same to the last bit on every machine."""
    return _njit(cache=True, no_cfunc_wrapper=True, error_model="numpy", _nrt=False)(function)


def inline(function: Callable[..., Any]) -> Any:
    """A helper of kernels, always inlined: passing a scene of 17 arrays by value costs more than most helpers do.

    Called from Python it runs as plain Python. A compiled entry for Python, which unpacks 17 arrays too, costs more to
    compile than most helpers do: with one for each of them the first render waited 1.7 times as long.
    """
    return _register(forceinline=True, no_cfunc_wrapper=True, **POLICY)(function)


def _prefetch(typingctx: Any, address: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer, word = ir.IntType(8).as_pointer(), ir.IntType(32)
        signature_of_it = ir.FunctionType(ir.VoidType(), [pointer, word, word, word])
        call = builder.module.declare_intrinsic("llvm.prefetch", [pointer], signature_of_it)
        read, near, data = (ir.Constant(word, value) for value in (0, 3, 1))
        builder.call(call, [builder.inttoptr(arguments[0], pointer), read, near, data])
        return context.get_dummy_value()

    return numba.types.void(numba.types.intp), generate


prefetch: Any = numba.extending.intrinsic(_prefetch)
"""Ask for the cache line at an address, which need not be valid, before it is needed."""


def compiled_anew(kernels: list[Any]) -> int:
    """How many of these kernels were compiled in this process rather than loaded from disk."""
    return sum(sum(k.stats.cache_misses.values()) for k in kernels if hasattr(k, "stats"))
