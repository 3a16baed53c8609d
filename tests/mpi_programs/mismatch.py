"""Opens a world in an environment that speaks of more processes than there are: refused, with a traceback."""

from reporting import say_shared_files

from causticmpi.distributed.world import open_world
from causticmpi.errors import InputError

if __name__ == "__main__":
    try:
        open_world()
    except InputError:
        say_shared_files()
        raise
