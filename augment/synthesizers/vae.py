"""VAE; see `swiftwrf.comparison.vae`."""

from __future__ import annotations

from augment.synthesizers.base import SYNTHESIZERS
from augment.synthesizers.published import Published
from swiftwrf.comparison import VaeConfig


@SYNTHESIZERS.register("vae", meaning="a convolutional decoder of position and latent numbers (VAE)", colour="#999933")
class VaeSynthesizer(Published):
    """Draws from the latent numbers' conditional mean, or from a sample of them."""

    samples = True
    config = VaeConfig
