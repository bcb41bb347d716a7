"""Drags a file onto a window and drops it there, as a file manager does: the source's side of the XDND protocol.

    python drag_file.py FILE X Y

X and Y are pixels of the screen. For X11 only, through libX11 itself: no other program offers files for a drag.
The protocol: freedesktop.org, Drag-and-Drop Protocol for the X Window System, version 5; versions since 3 have these
messages alike.
"""

import ctypes
import select
import sys
import time
from pathlib import Path

SECONDS = 30  # that the window has for each answer
CLIENT_MESSAGE, SELECTION_REQUEST, SELECTION_NOTIFY = 33, 30, 31
ACCEPTED = 1  # bit of XdndStatus
VERSION = 3
Atom = Window = Time = ctypes.c_ulong
HEADER = (
    ("type", ctypes.c_int),
    ("serial", ctypes.c_ulong),
    ("send_event", ctypes.c_int),
    ("display", ctypes.c_void_p),
)


class ClientMessage(ctypes.Structure):
    _fields_ = (*HEADER, ("window", Window), ("kind", Atom), ("format", ctypes.c_int), ("data", ctypes.c_long * 5))


class SelectionRequest(ctypes.Structure):
    _fields_ = (
        *HEADER, ("owner", Window), ("requestor", Window), ("selection", Atom), ("target", Atom), ("property", Atom),
        ("time", Time),
    )  # fmt: skip


class SelectionNotify(ctypes.Structure):
    _fields_ = (
        *HEADER, ("requestor", Window), ("selection", Atom), ("target", Atom), ("property", Atom), ("time", Time),
    )  # fmt: skip


class Event(ctypes.Union):
    _fields_ = (
        ("type", ctypes.c_int), ("message", ClientMessage), ("request", SelectionRequest), ("notify", SelectionNotify),
        ("room", ctypes.c_long * 24),
    )  # fmt: skip


class FileDrag:
    """A drag of one file, over the window of this screen that accepts files."""

    def __init__(self, path: Path):
        self.text = path.resolve().as_uri().encode() + b"\r\n"
        self.x11 = ctypes.CDLL("libX11.so.6")
        for name in ("XOpenDisplay", "XDefaultRootWindow", "XInternAtom", "XCreateSimpleWindow"):
            getattr(self.x11, name).restype = ctypes.c_void_p
        self.display = ctypes.c_void_p(self.x11.XOpenDisplay(None))
        if not self.display:
            raise OSError("no X server: expected DISPLAY to name one")
        root = Window(self.x11.XDefaultRootWindow(self.display))
        self.window = self._window_that_accepts(root)
        self.source = Window(self.x11.XCreateSimpleWindow(self.display, root, 0, 0, 1, 1, 0, 0, 0))
        self.x11.XSetSelectionOwner(self.display, self.atom("XdndSelection"), self.source, Time(0))

    def atom(self, name: str) -> Atom:
        return Atom(self.x11.XInternAtom(self.display, name.encode(), False))

    def _window_that_accepts(self, window: Window) -> Window | None:
        """The first window at or below `window` with the property XdndAware."""
        count = ctypes.c_int()
        self.x11.XListProperties.restype = ctypes.POINTER(Atom)
        names = self.x11.XListProperties(self.display, window, ctypes.byref(count))
        if self.atom("XdndAware").value in names[: count.value]:
            return window
        root, parent, children, count = Window(), Window(), ctypes.POINTER(Window)(), ctypes.c_uint()
        places = map(ctypes.byref, (root, parent, children, count))
        if self.x11.XQueryTree(self.display, window, *places):
            for child in children[: count.value]:
                if (found := self._window_that_accepts(Window(child))) is not None:
                    return found
        return None

    def drop(self, x: int, y: int) -> None:
        """Move the file to `x`, `y` of the screen in some steps and let it go."""
        if self.window is None:
            raise OSError("no window of this screen accepts files: expected one with the property XdndAware")
        copy = self.atom("XdndActionCopy").value
        self._send("XdndEnter", VERSION << 24, self.atom("text/uri-list").value)
        for step in (3, 2, 1, 0):
            self._send("XdndPosition", 0, (x - 10 * step) << 16 | y, 0, copy)
            status = self._answer("XdndStatus")
            time.sleep(0.1)
        if not status.data[1] & ACCEPTED:
            raise OSError("the window refuses the file")
        self._send("XdndDrop")
        self._answer("XdndFinished")

    def _send(self, kind: str, *data: int) -> None:
        numbers = (ctypes.c_long * 5)(self.source.value, *data)
        message = ClientMessage(CLIENT_MESSAGE, 0, 1, self.display, self.window, self.atom(kind), 32, numbers)
        self._deliver(self.window, Event(message=message))

    def _deliver(self, window: Window, event: Event) -> None:
        self.x11.XSendEvent(self.display, window, False, ctypes.c_long(0), ctypes.byref(event))
        self.x11.XFlush(self.display)

    def _answer(self, kind: str) -> ClientMessage:
        """The window's next message of that kind; where it asks for the name of the file meanwhile, it gets it."""
        end, wanted = time.monotonic() + SECONDS, self.atom(kind).value
        while time.monotonic() < end:
            if not self.x11.XPending(self.display):
                select.select([self.x11.XConnectionNumber(self.display)], [], [], 0.1)
                continue
            event = Event()
            self.x11.XNextEvent(self.display, ctypes.byref(event))
            if event.type == SELECTION_REQUEST:
                self._hand_over(event.request)
            elif event.type == CLIENT_MESSAGE and event.message.kind == wanted:
                return event.message
        raise TimeoutError(f"no {kind} within {SECONDS} s")

    def _hand_over(self, request: SelectionRequest) -> None:
        place = Window(request.requestor), Atom(request.property), Atom(request.target)
        self.x11.XChangeProperty(self.display, *place, 8, 0, self.text, len(self.text))
        notify = SelectionNotify(
            SELECTION_NOTIFY, 0, 1, self.display, request.requestor, request.selection, request.target,
            request.property, request.time,
        )  # fmt: skip
        self._deliver(Window(request.requestor), Event(notify=notify))


if __name__ == "__main__":
    FileDrag(Path(sys.argv[-3])).drop(int(sys.argv[-2]), int(sys.argv[-1]))
