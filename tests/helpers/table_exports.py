"""The command that exports tables, run in this process."""

from tables import __main__


def run(capsys, *arguments):
    """Exit code, stdout and stderr of `python -m tables export`."""
    try:
        code = __main__.main(["export", *map(str, arguments)])
    except SystemExit as end:
        code = end.code
    return code, *capsys.readouterr()
