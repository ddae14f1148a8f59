"""Field models: each is fitted to measured spectra and predicts spectra at any position. One file, one model."""

from swiftwrf.choices import FIELD_MODELS
from swiftwrf.models import coarray, geometry, interpolator, neighbours, swiftwrf, swiftwrf_paper  # noqa: F401 (each defines a saved kind)
from swiftwrf.models.base import ARRAY, FIXED_END, FieldConfig, FieldModel, make_model
from swiftwrf.models.prediction import Prediction

__all__ = ["ARRAY", "FIELD_MODELS", "FIXED_END", "FieldConfig", "FieldModel", "Prediction", "make_model"]
