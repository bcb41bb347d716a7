"""What stands in Markdown files: links, anchors, blocks of code."""

import re

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def links_of(text: str) -> list[str]:
    """Targets of links and pictures that are not on the web."""
    found = LINK.findall(FENCE.sub("", text))
    return [target for target in found if not target.startswith(("https://", "http://"))]


def anchors_of(text: str) -> set[str]:
    """Names by which links reach the headings."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
