"""Long work that can be left at any moment, whether or not it asks."""

from __future__ import annotations

import threading
from collections.abc import Callable

from ...scene import Cancelled

Progress = Callable[[str, float], "bool | None"]
ASK_SECONDS = 0.05


def stoppable(work: Callable[[Progress], object], progress: Progress):
    """What `work(report)` returns; it runs in a thread of its own and must not use bpy.

    `progress(stage, fraction)` gets what the work reported last, again and again, in the thread of the caller. Raises
    what the work raises, and Cancelled as soon as `progress` returns False: the work then ends at its next report.
    """
    state: dict = {"last": ("", 0.0)}
    stop = threading.Event()

    def report(stage: str, fraction: float) -> bool:
        state["last"] = stage, fraction
        return not stop.is_set()

    def run() -> None:
        try:
            state["result"] = work(report)
        except BaseException as error:
            state["error"] = error

    thread = threading.Thread(target=run, name="LTSH work", daemon=True)
    thread.start()
    try:
        while thread.is_alive():
            if progress(*state["last"]) is False:
                raise Cancelled(f"cancelled at {state['last'][0] or 'the start'}")
            thread.join(ASK_SECONDS)
    finally:
        stop.set()
    if "error" in state:
        raise state["error"]
    return state["result"]
