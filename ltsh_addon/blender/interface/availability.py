"""Which libraries of the extension this Blender has. Imports no bpy.

Live preview works without any; whatever reads or writes EXR files needs OpenEXR, which the extension's zips bring.
"""

from __future__ import annotations

import functools
import platform


@functools.cache
def missing_libraries() -> str | None:
    """One line that says what is missing and what to do, for beside grey buttons; None where all is there.

    Tried once, since panels ask with every redraw: what comes later is found when the add-on is enabled again.
    """
    try:
        import OpenEXR

        OpenEXR.File  # noqa: B018 - a namespace left by an incomplete removal imports too
    except (ImportError, AttributeError) as error:
        version = ".".join(platform.python_version_tuple()[:2])
        return (
            f"OpenEXR cannot be imported ({' '.join(str(error).split())}): install the LTSH zip for "
            f"{platform.system()} {platform.machine()} and Python {version}; only Live Preview works without"
        )
    return None
