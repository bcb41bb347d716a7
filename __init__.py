"""The extension's entry point, which Blender expects beside blender_manifest.toml.

Imports stand inside the functions: pytest imports this file without a parent package.
"""


def register():
    """Add everything of LTSH to Blender."""
    from . import ltsh_addon

    ltsh_addon.register()


def unregister():
    """Remove everything `register` added."""
    from . import ltsh_addon

    ltsh_addon.unregister()
