"""Several stations: data of one transmission at each, one posterior of all, triangulation, and rooms that agree."""

import numpy as np
import pytest
import torch
from rooms import OFFICE_WALLS

import swiftwrf
from swiftwrf import InputError, MatchedField, Stations, simulated_stations
from swiftwrf.data.simulated import STATIONS
from swiftwrf.locate.triangulation import bearings, peak_directions, triangulated
from swiftwrf.models.geometry import GeometryModel, Plane
from swiftwrf.models.geometry.agreement import agreed

GRID = swiftwrf.AngularGrid.hemisphere(15, 60)


@pytest.fixture(scope="module")
def office() -> tuple[Stations, Stations]:
    data = simulated_stations(n=48, stations=2, seed=3, grid=GRID)
    return data[:40], data[40:]


@pytest.fixture(scope="module")
def rooms(office) -> dict[str, GeometryModel]:
    train, _ = office
    return {name: GeometryModel.of_planes(train.of(name)[1], OFFICE_WALLS) for name in train.names}


def small() -> MatchedField:
    return MatchedField(spacing=0.5, max_cells=4000, n_best=60, n_background=20, n_rounds=2, n_calibration=40)


@pytest.fixture(scope="module")
def locator(office, rooms) -> MatchedField:
    return small().fit(office[0], room=rooms)


class TestData:
    def test_rows_of_one_index_are_one_transmission(self):
        first = swiftwrf.simulated_room(n=20, grid=GRID)
        data = Stations({"a": first[[3, 1, 7]], "b": first[[7, 12]]})
        assert data.index.tolist() == [1, 3, 7, 12]
        assert data.row.tolist() == [[1, -1], [0, -1], [2, 0], [-1, 1]]
        assert data.position.equal(first.position[[1, 3, 7, 12]])
        rows, spectra = data.of("b")
        assert rows.tolist() == [2, 3]
        assert spectra.index.tolist() == [7, 12]

    def test_subset_keeps_what_each_station_received(self):
        first = swiftwrf.simulated_room(n=20, grid=GRID)
        data = Stations({"a": first, "b": first[5:]})
        part = data[[19, 2, 8]]
        assert part.index.tolist() == [19, 2, 8]
        rows, spectra = part.of("b")
        assert rows.tolist() == [0, 2]
        assert spectra.spectrum.equal(first.spectrum[[19, 8]])
        assert part.only("b").received[:, 0].tolist() == [True, False, True]

    def test_splits_are_those_of_a_station_that_received_all(self):
        first = swiftwrf.simulated_room(n=20, grid=GRID)
        named = first.derived(named_splits={"days": (torch.arange(12), torch.arange(12, 20))})
        train, test = Stations({"b": first[5:], "a": named}).split("days")
        assert (len(train), len(test)) == (12, 8)
        assert train.received[:, 0].sum() == 7

    def test_refusals(self):
        first = swiftwrf.simulated_room(n=20, grid=GRID)
        moved = first.derived(position=first.position + 0.01)
        receiver = swiftwrf.simulated_room(n=20, grid=GRID, moving="receiver")
        for spectra, words in (
            ({}, "one station or more"),
            ({"a": first[[0, 0]]}, "two rows of one transmission"),
            ({"a": first, "b": moved}, "0.0173 m away"),
            ({"a": first, "b": receiver}, "must be the same"),
        ):
            with pytest.raises(InputError, match=words):
                Stations(spectra)
        with pytest.raises(InputError, match="no station 'c'; choose one of a, b"):
            Stations({"a": first, "b": first}).of("c")


class TestPosterior:
    def test_one_station_is_plain_spectra(self, office, rooms):
        train, test = office
        spectra, asked = (data.of("west")[1] for data in office)
        plain = small().fit(spectra, room=rooms["west"])
        named = small().fit(train.only("west"), room={"west": rooms["west"]})
        assert named.weight.equal(plain.weight)
        assert named.inflation == plain.inflation
        assert named.locate(test.only("west")).log_weight.equal(plain.locate(asked).log_weight)

    def test_two_stations_locate_better_than_each(self, office, rooms, locator):
        train, test = office

        def median(data: Stations, own: MatchedField) -> float:
            return float((own.locate(data).median - data.position).norm(dim=1).median())

        both = median(test, locator)
        for name in test.names:
            alone = small().fit(train.only(name), room={name: rooms[name]})
            assert both < 0.9 * median(test.only(name), alone)

    def test_log_masses_are_sums_over_the_stations_that_received(self, office, locator):
        """A transmission that a station did not receive has the posterior by the others."""
        _, test = office
        part = test.derived(row=torch.where(torch.arange(len(test))[:, None] % 2 == torch.tensor([0, 1]), test.row, -1))
        found, west = locator.locate(part), locator.locate(test.only("west"))
        # rows 0, 2, ... were received in the west alone
        assert found.log_weight[::2].allclose(west.log_weight[::2], atol=1e-4)
        assert found.median[::2].allclose(west.median[::2], atol=1e-3)

    def test_a_row_without_any_station_has_the_prior(self, office, locator):
        _, test = office
        nothing = test.derived(row=torch.full_like(test.row, -1))
        radius = locator.locate(nothing).credible_radius()
        assert float(radius.min()) > 1.0  # of a region of 4.5 x 4 x 0.6 m

    def test_order_of_stations_has_no_effect(self, office, rooms, locator):
        train, test = office
        turned = small().fit(train.only("east", "west"), room=rooms)
        assert turned.stations == ("east", "west")
        assert turned.locate(test).median.allclose(locator.locate(test).median, atol=1e-2)

    def test_directions_are_those_of_each_station(self, office, locator):
        _, test = office
        found = locator.predict(test)
        posterior = locator.locate(test)
        for number, name in enumerate(test.names):
            label = test.of(name)[1].direction_at(posterior.median)
            assert found.shape == (len(test), 2, 2)
            error = swiftwrf.metrics.angle_errors(found[:, number], label)["great_circle"].rad2deg()
            assert float(error.median()) < 3.0

    def test_a_saved_locator_is_equal(self, office, locator, tmp_path):
        locator.save(tmp_path / "locator.safetensors")
        found = swiftwrf.load(tmp_path / "locator.safetensors")
        assert found.stations == ("west", "east")
        assert found.locate(office[1]).log_weight.equal(locator.locate(office[1]).log_weight)

    def test_refusals(self, office, rooms, locator):
        train, test = office
        few = Stations({"west": train.of("west")[1], "east": train.of("east")[1][:9]})
        for call, words in (
            (lambda: locator.locate(test.of("west")[1]), "takes Stations with west, east"),
            (lambda: locator.locate(Stations({"roof": test.of("west")[1]})), "not to roof"),
            (lambda: locator.room, "a room for each station"),
            (lambda: locator.direction(locator.locate(test), "roof"), "choose one of west, east"),
            (lambda: small().fit(train, room={"west": rooms["west"]}), "other stations: east"),
            (lambda: small().fit(few), "got 9 of station east"),
        ):
            with pytest.raises(InputError, match=words):
                call()


class TestTriangulation:
    def test_lines_meet_at_the_position(self):
        data = simulated_stations(n=12, stations=4, grid=GRID)
        label = {name: data.of(name)[1].label for name in data.names}
        found = triangulated(*bearings(data, label, data.position.mean(dim=0)), start=torch.zeros(3))
        assert found.allclose(data.position, atol=1e-4)

    @pytest.mark.parametrize("moving", ["transmitter", "receiver"])
    def test_level_arrays_above_the_positions(self, moving):
        """Their directions are folded to the upper half-space, and the positions are below."""
        position = simulated_stations(n=9, stations=1, grid=GRID).position
        array, spectra = swiftwrf.simulated_room(n=10, grid=GRID).array, {}
        for name, corner in (("a", (0.2, 0.3, 2.8)), ("b", (7.8, 0.4, 2.8)), ("c", (0.3, 5.7, 2.8))):
            ends = {"fixed_position": corner, "rotation": torch.eye(3)}
            spectra[name] = swiftwrf.Spectra(
                torch.rand(9, 15, 60), position, array=array, moving=moving, grid=GRID, **ends
            )
        data = Stations(spectra)
        label = {name: spectra[name].label for name in spectra}
        found = triangulated(*bearings(data, label, position.mean(dim=0)), start=torch.zeros(3))
        assert found.allclose(position, atol=1e-4)

    def test_least_squares(self):
        """The result is numpy's solution of the stacked equations of all lines."""
        data = simulated_stations(n=5, stations=3, grid=GRID)
        origin, line = bearings(data, peak_directions(data), data.position.mean(dim=0))
        start = torch.tensor([4.0, 3.0, 1.0])
        found = triangulated(origin, line, start)
        for row in range(len(data)):
            across = [np.eye(3) - np.outer(unit, unit) for unit in line[row].numpy()]
            target = [part @ point for part, point in zip(across, origin.numpy(), strict=True)]
            expected = np.linalg.lstsq(np.concatenate(across), np.concatenate(target), rcond=None)[0]
            assert np.allclose(found[row], expected, atol=1e-3)

    def test_a_single_line_leads_to_the_point_nearest_to_the_start(self):
        line = torch.tensor([[[1.0, 0.0, 0.0], [torch.nan] * 3]])
        found = triangulated(torch.zeros(2, 3), line, torch.tensor([5.0, 1.0, 0.0]))
        assert found[0].allclose(torch.tensor([5.0, 0.0, 0.0], dtype=torch.float64), atol=1e-4)

    def test_poses_of_the_office_face_the_room(self):
        centre = torch.tensor([4.0, 3.0, 1.5], dtype=torch.float64)
        for pose in STATIONS.values():
            normal = pose.rotation @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
            assert float(normal @ (centre - torch.tensor(pose.position, dtype=torch.float64))) > 1.0


class TestAgreement:
    def test_the_most_certain_station_decides(self, office):
        train, _ = office
        spectra = {name: train.of(name)[1] for name in train.names}

        def room(name: str, offset: float, probability: float) -> GeometryModel:
            planes = [Plane((1.0, 0.0, 0.0), offset, -0.6, probability=probability), *OFFICE_WALLS[2:]]
            return GeometryModel.of_planes(spectra[name], planes)

        rooms = {"west": room("west", 8.062, 0.6), "east": room("east", 8.0, 0.99)}
        found = agreed(rooms, spectra)
        assert found["west"].planes[0].offset_m == pytest.approx(8.0, abs=0.02)
        assert found["east"].planes[0].offset_m == pytest.approx(8.0, abs=0.02)

    def test_furniture_is_found_again_where_planes_moved(self, office, monkeypatch):
        train, _ = office
        spectra = {name: train.of(name)[1] for name in train.names}
        off = Plane((1.0, 0.0, 0.0), 8.062, -0.6, probability=0.6)
        rooms = {
            name: GeometryModel.of_planes(spectra[name], [plane, *OFFICE_WALLS[2:]])
            for name, plane in (("west", off), ("east", OFFICE_WALLS[1]))
        }
        furnished = []
        monkeypatch.setattr(
            GeometryModel, "furnish", lambda room, train: furnished.append((room, train.fixed_position))
        )
        found = agreed(rooms, spectra)
        assert [room for room, _ in furnished] == [found["west"]]
        assert furnished[0][1].equal(spectra["west"].fixed_position)

    def test_rooms_that_a_locator_searches_agree(self, office, rooms, monkeypatch):
        train, _ = office
        off = [OFFICE_WALLS[0], Plane((1.0, 0.0, 0.0), 8.062, -0.6, probability=0.6), *OFFICE_WALLS[2:]]
        searched = {
            "west": GeometryModel.of_planes(train.of("west")[1], off),
            "east": rooms["east"],
        }

        def fit(_: GeometryModel, spectra, like=None, **__) -> GeometryModel:
            return like or next(
                room for room in searched.values() if room.fixed_position.equal(spectra.fixed_position.double())
            )

        monkeypatch.setattr(GeometryModel, "fit", fit)
        assert small().fit(train).rooms["west"].planes[1].offset_m == pytest.approx(8.0, abs=0.02)
        assert small().fit(train, room=searched).rooms["west"].planes[1].offset_m == pytest.approx(8.062, abs=0.01)

    def test_a_station_keeps_a_plane_that_its_spectra_determine(self, office):
        train, _ = office
        spectra = {name: train.of(name)[1] for name in train.names}
        rooms = {
            "west": GeometryModel.of_planes(spectra["west"], OFFICE_WALLS),
            "east": GeometryModel.of_planes(
                spectra["east"], [Plane((0.0, 0.0, -1.0), 0.06, -0.6), Plane((0.0, 0.0, 1.0), 3.0, -0.6)]
            ),
        }
        rooms["west"].estimate.planes[4] = Plane((0.0, 0.0, -1.0), 0.0, -0.6, probability=0.95)
        found = agreed(rooms, spectra)
        assert found["west"].planes[4].offset_m == pytest.approx(0.0, abs=0.01)
