"""DCGAN; see `swiftwrf.comparison.dcgan`."""

from __future__ import annotations

from augment.synthesizers.base import SYNTHESIZERS
from augment.synthesizers.published import Published
from swiftwrf.comparison import DcganConfig


@SYNTHESIZERS.register(
    "dcgan", meaning="a convolutional generator held against a discriminator (DCGAN)", colour="#661100"
)
class DcganSynthesizer(Published):
    """Draws from no noise, or from a sample of it."""

    samples = True
    config = DcganConfig
