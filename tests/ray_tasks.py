"""Tasks that processes of a Ray cluster can import."""

import os
import time


def double_or_die(item, advance, is_stopped):
    """Twice the number; "exit" ends the process."""
    if item == "exit":
        os._exit(7)
    advance(1)
    return 2 * item


def slow_file(path, advance, is_stopped):
    """Write a file after a second, as work does."""
    time.sleep(1.0)
    path.write_text(path.name)
    return path.name


def refuse(item, advance, is_stopped):
    """Fail as a user error."""
    from rlftsim.errors import DataError

    raise DataError(f"item {item} is broken")


def reserved_memory(item, advance, is_stopped, weights=b""):
    """Bytes that the cluster holds free for the process."""
    import ray

    return ray.get_runtime_context().get_assigned_resources()["memory"]
