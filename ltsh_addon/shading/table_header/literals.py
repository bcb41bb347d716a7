"""Numbers as text of C and GLSL."""

import numpy as np


def float_literal(value) -> str:
    """The shortest literal that is exactly `value` rounded to float32."""
    return f"{np.float32(value)!s}f"
