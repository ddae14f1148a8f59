"""How far a fast backend may be from the definition in float64; the one table of it.

Values as a share of the sum of |weight|, gradients as relative L2, both times a case's `slack`. Float32 rounding sets the
entries without a cutoff; for values the cutoff itself those with one.
"""

VALUE_TOLERANCE = {None: 5e-6, 1e-4: 3e-4}
GRADIENT_TOLERANCE = {None: 1e-5, 1e-4: 1e-5}
