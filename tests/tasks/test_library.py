"""Results of the library, which need no directory, process or terminal."""

import pytest

import augment
import swiftwrf
from swiftwrf import AngularGrid, InputError


def turbo():
    data = swiftwrf.simulated_room(n=40, grid=AngularGrid.hemisphere(10, 40))
    return augment.turbo_learning(data, measured=0.5, models=["nearest"], estimators=["peak"], extra=0)


RESULTS = {
    "angles": turbo,
    "RSSI": lambda: swiftwrf.rssi.compare(swiftwrf.rssi_room(n=60), receivers=["6"]),
    "positions": lambda: swiftwrf.locate.compare(swiftwrf.rssi_room(n=80), n_cells=300),
}


@pytest.mark.parametrize("name", RESULTS)
def test_a_result_writes_the_report_of_its_command_into_one_file(name, tmp_path, capsys):
    result, file = RESULTS[name](), tmp_path / "report.html"
    result.report(file)
    html = file.read_text(encoding="utf-8")
    best = result.summary().index[0]
    assert html.count("<svg") > 3
    assert best in html
    assert f"{result.summary()['median'].iloc[0]:.2f}" in html
    assert "swiftwrf view" not in html, "commands on a directory of a run that does not exist"
    assert 'href="figures' not in html
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]
    with pytest.raises(InputError, match="exists already"):
        result.report(file)


def test_the_best_estimator_of_a_result_predicts_and_is_saved(tmp_path):
    result = turbo()
    result.best.save(tmp_path / "best.safetensors")
    spectra = result.experiment.test.spectrum
    assert swiftwrf.load(tmp_path / "best.safetensors").predict(spectra).equal(result.best.predict(spectra))
