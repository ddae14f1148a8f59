"""What a fitted synthesizer leaves in the run's directory beside its spectra: for the report, and for those who go on."""

from __future__ import annotations

from pathlib import Path

from augment.choose import SLOW
from augment.synthesizers import Synthesizer
from swiftwrf import Spectra, SwiftWRF
from swiftwrf.models.geometry import room_of
from swiftwrf.runtime.checkpoint import Saved
from tasks.aoa.field import motion, strongest_direction
from tasks.records import write_json, write_npz


def keep(name: str, synthesizer: Synthesizer, share: float, measured: Spectra, test: Spectra, folder: Path) -> None:
    """The model where there is one, the room where one was found, and the field over the region.

    Args:
        name: of the synthesizer.
        synthesizer: fitted to `measured`.
        share: of the training spectra that are measured, which the files are named by.
        measured, test: whose positions the report draws.
        folder: of the run.
    """
    mix = f"mix{share:g}"
    if synthesizer.model is not None:
        prefix = "model" if name == "swiftwrf" else name
        synthesizer.model.save(folder / f"{prefix}-{mix}.safetensors")
        _keep_room(synthesizer.model, mix, measured, test, folder)
    if name not in SLOW:
        field = strongest_direction(synthesizer, measured, synthesizer.settings.seed)
        write_npz(folder / f"field-{name}-{mix}.npz", field)
    if isinstance(synthesizer.model, SwiftWRF):
        write_npz(folder / f"motion-{mix}.npz", motion(synthesizer.model, measured))


def _keep_room(model: Saved, mix: str, measured: Spectra, test: Spectra, folder: Path) -> None:
    room = room_of(model)
    if room is None:
        return
    write_json(folder / f"geometry-{mix}.json", room.to_json())
    at, gain, order = room.image_sources()
    places = {
        "measured": measured.position,
        "test": test.position,
        "fixed": room.fixed_position,
        "image": at,
        "gain": gain,
        "order": order,
    }
    write_npz(folder / f"room-{mix}.npz", {name: value.numpy() for name, value in places.items()})
