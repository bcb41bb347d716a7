"""Processes that shade the same samples at the same time and share nothing: what a machine lets two of them reach."""

import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[2]), str(Path(__file__).parent)]


@contextmanager
def independent_processes(number, table, count, lights, fresnel):
    """A function that has `number` processes shade `floor_scene(count, lights, fresnel)` by one table, specular, at the
    same time, and returns when all have. They are ready when the context is entered and end with it."""
    command = [sys.executable, __file__, table, str(count), str(lights), fresnel]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    children = [subprocess.Popen(command, text=True, bufsize=1, **pipes) for _ in range(number)]

    def answers():
        for child in children:
            if not child.stdout.readline():
                raise RuntimeError("a process that was to be measured has ended")

    def run():
        for child in children:
            child.stdin.write("\n")
        answers()

    try:
        answers()
        yield run
    finally:
        for child in children:
            child.kill()
            child.communicate()


def main():
    """Shade once for every line of the input, and answer with a line."""
    from bench_scenes import floor_scene

    from ltsh_addon import shading

    table, count, lights, fresnel = sys.argv[1:]
    scene = floor_scene(int(count), int(lights), fresnel)
    print("ready", flush=True)
    for _ in sys.stdin:
        shading.shade(*scene, table, passes=["specular"], workers=1)
        print("done", flush=True)


if __name__ == "__main__":
    main()
