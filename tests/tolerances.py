"""Tolerances of the fast backends relative to the definition in float64.

Values are relative to the sum of |weight|, gradients are relative L2, and both are multiplied by a case's `slack`. Without a
cutoff, float32 rounding determines them. With one, the cutoff determines those of values.
"""

VALUE_TOLERANCE = {None: 5e-6, 1e-4: 3e-4}
GRADIENT_TOLERANCE = {None: 1e-5, 1e-4: 1e-5}
