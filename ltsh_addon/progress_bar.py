"""A progress bar with the stage and the time left, on a terminal; plain lines, sparsely, in a log."""

from __future__ import annotations

import time

BAR_WIDTH = 28
LOG_INTERVAL = 10.0  # seconds


class ProgressBar:
    """Callable as progress(stage, fraction); `finish` ends the line."""

    def __init__(self, stream, *, quiet: bool = False):
        self._stream = stream
        self._quiet = quiet or stream is None  # print would take None for stdout
        self._terminal = bool(getattr(stream, "isatty", lambda: False)())
        self._stage = None
        self._stage_start = 0.0
        self._fraction = 0.0
        self._last_shown = 0.0
        self._line_open = False

    def __call__(self, stage: str, fraction: float) -> bool:
        """Show where `stage` stands, fraction in [0, 1]; returns True: a bar never stops the work."""
        if self._quiet:
            return True
        now = time.monotonic()
        if stage != self._stage:
            if self._line_open and self._fraction < 1.0:  # many stages end without a last word
                self._draw(self._stage, 1.0, now)
            self.finish()
            self._stage, self._stage_start, self._last_shown = stage, now, -1e9
        self._fraction = fraction
        ended = fraction >= 1.0
        if self._terminal:
            if ended or now - self._last_shown > 0.1:
                self._last_shown = now
                self._draw(stage, fraction, now)
        elif ended or now - self._last_shown > LOG_INTERVAL:
            self._last_shown = now
            print(f"{stage}: {100.0 * fraction:.0f} % {self._remaining(fraction, now)}".rstrip(), file=self._stream)
        return True

    def _draw(self, stage, fraction, now):
        filled = round(min(max(fraction, 0.0), 1.0) * BAR_WIDTH)
        bar = "#" * filled + "-" * (BAR_WIDTH - filled)
        text = f"{stage:<24.24} [{bar}] {100.0 * fraction:3.0f} % {self._remaining(fraction, now)}"
        self._stream.write(f"\r{text:<79}")
        self._stream.flush()
        self._line_open = True

    def _remaining(self, fraction, now) -> str:
        elapsed = now - self._stage_start
        if fraction >= 1.0:
            return f"({elapsed:.1f} s)"
        if elapsed < 1.0 or fraction < 0.02:
            return ""
        return f"({elapsed / fraction - elapsed:.0f} s left)"

    def finish(self) -> None:
        """End the current line, so that what follows starts on its own."""
        if self._line_open:
            self._stream.write("\n")
            self._stream.flush()
            self._line_open = False


def say(text: str, stream) -> None:
    """Print to `stream`, which is None when it was closed; letters that its encoding lacks are spelled out."""
    if stream is not None:
        encoding = stream.encoding or "ascii"
        print(text.encode(encoding, "backslashreplace").decode(encoding), file=stream)
