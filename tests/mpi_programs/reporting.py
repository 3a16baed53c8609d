"""What the programs tell the tests: whole lines, which a launcher does not mix with those of other ranks."""

import os


def say(*words: object) -> None:
    """Write one line to standard output at once."""
    os.write(1, (" ".join(map(str, words)) + "\n").encode())


def say_shared_files() -> None:
    """Say "shm PATH" for each mapped file in /dev/shm: so that tests look for left-overs, and remove only their own."""
    with open("/proc/self/maps") as maps:
        files = {line.split(maxsplit=5)[5].strip() for line in maps if "/dev/shm/" in line}
    for file in sorted(files):
        say("shm", file.removesuffix(" (deleted)"))
