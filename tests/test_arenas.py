"""The allocator's arenas of a training process."""

import platform
import subprocess
import sys

import pytest

ALLOCATE = """
import ctypes, re, sys, tempfile, threading
if sys.argv[1] == "shared":
    from mtjax.training.allocator import share_arenas
    share_arenas()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.fopen.restype = ctypes.c_void_p, [ctypes.c_size_t], ctypes.c_void_p
waiting = threading.Barrier(12)
def work():
    libc.malloc(1000)
    waiting.wait()
threads = [threading.Thread(target=work) for _ in range(12)]
for thread in threads: thread.start()
for thread in threads: thread.join()
with tempfile.NamedTemporaryFile() as found:
    file = libc.fopen(found.name.encode(), b"w")
    libc.malloc_info(0, ctypes.c_void_p(file))
    libc.fclose(ctypes.c_void_p(file))
    print(len(re.findall("<heap nr", found.read().decode())))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="arenas are glibc's")
def test_threads_share_two_arenas():
    count = lambda which: int(subprocess.run([sys.executable, "-c", ALLOCATE, which], stdout=-1, check=True).stdout)
    assert count("shared") <= 2 < count("own")
