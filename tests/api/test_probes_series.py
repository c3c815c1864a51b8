"""The probes' time series, as JSON and as CSV."""
import csv
import http.client

import pytest
from boxes import WATER_STEPS, water
from fbard import PATIENCE, until


@pytest.fixture(scope="module")
def sampled(daemon):
    run = daemon.create(water(output={"probe_interval": 0.01}))["id"]
    daemon.wait(run, "completed")
    yield run
    daemon.away(run)


def read_csv(text):
    rows = list(csv.reader(text.splitlines()))
    return rows[0], [[float(v) if v else None for v in row] for row in rows[1:]]


def flat(series):
    """The JSON answer as the columns that the CSV has."""

    def number_lists(prefix, value):
        if isinstance(value, dict):
            for key, inner in value.items():
                yield from number_lists(f"{prefix}.{key}", inner)
        elif value and isinstance(value[0], (list, dict)):
            keys = value[0].keys() if isinstance(value[0], dict) else "xyz"[: len(value[0])]
            for n, key in enumerate(keys):
                yield f"{prefix}.{key}", [v[key] if isinstance(v, dict) else v[n] for v in value]
        else:
            yield prefix, value

    result = {"step": series["step"], "time": series["time"]}
    for name, value in series["probes"].items():
        result.update(number_lists(name, value))
    return result


def test_csv_has_a_column_a_scalar_and_one_a_component(daemon, sampled):
    columns, rows = read_csv(daemon.csv(sampled))
    assert columns[:3] == ["step", "time", "front"]
    assert {"momentum.x", "momentum.y", "middle.x", "middle.y"} <= set(columns)
    assert {"energy.kinetic", "energy.strain", "energy.potential", "energy.total"} <= set(columns)
    assert "momentum.z" not in columns
    assert all(len(row) == len(columns) and None not in row for row in rows)


def test_samples_are_taken_at_probe_interval(daemon, sampled):
    _, rows = read_csv(daemon.csv(sampled))
    assert [row[0] for row in rows] == list(range(0, WATER_STEPS + 1, 10))
    for row in rows:
        assert row[1] == pytest.approx(row[0] * 1e-3, abs=1e-12)


def test_default_interval_is_a_500th_of_the_end(daemon, name):
    daemon.create(water(time={"end": 1.0}), id=name)
    daemon.wait(name, "completed")
    _, rows = read_csv(daemon.csv(name))
    assert [row[0] for row in rows] == list(range(0, 1001, 2))
    daemon.away(name)


def test_json_and_csv_are_equal(daemon, sampled):
    columns, rows = read_csv(daemon.csv(sampled))
    series = daemon.get(f"/v1/runs/{sampled}/probes")
    assert flat(series) == {column: [row[k] for row in rows] for k, column in enumerate(columns)}


def test_json_is_the_default_and_may_be_asked_for(daemon, sampled):
    for accept in (None, "*/*", "application/json", "application/json, text/csv;q=0.5", "text/html"):
        headers = {"Accept": accept} if accept else {}
        reply = daemon.request("GET", f"/v1/runs/{sampled}/probes", headers=headers)
        assert reply.status == 200 and reply.type == "application/json" or reply.status == 406, reply


@pytest.mark.parametrize("lines, type_", [
    (["text/csv;q=0, */*"], "application/json"),
    (["text/csv;q=0"], "application/json"),
    (["application/json;q=0.3, text/csv;q=0.4"], "text/csv"),
    (["application/json;q=0.3, text/*;q=0.4"], "text/csv"),
    (["*/*;q=0.9, application/json;q=0.8"], "text/csv"),
    (["application/json;q=0", "*/*;q=0.1"], "text/csv"),
    (["application/json;q=0.5", "text/csv;q=0.6"], "text/csv"),
    (["text/csvx, application/json;q=0.1"], "application/json"),
    (["application/json;q=0, text/csv;q=0"], "application/json"),  # neither: RFC 9110, 12.5.1
])  # fmt: skip
def test_quality_values_decide(daemon, sampled, lines, type_):
    connection = http.client.HTTPConnection(daemon.host, timeout=PATIENCE)
    connection.putrequest("GET", f"/v1/runs/{sampled}/probes")
    for line in lines:
        connection.putheader("Accept", line)
    connection.endheaders()
    answer = connection.getresponse()
    assert answer.status == 200 and answer.headers.get_content_type() == type_
    assert answer.headers["vary"] == "Accept"
    answer.read()
    connection.close()


@pytest.mark.parametrize("since, first", [(0, 10), (9, 10), (10, 20), (95, 100), (100, None), (10**12, None)])
def test_since_step_gives_what_came_after(daemon, sampled, since, first):
    _, rows = read_csv(daemon.csv(sampled, f"?since_step={since}"))
    assert [row[0] for row in rows] == (list(range(first, WATER_STEPS + 1, 10)) if first else [])
    assert daemon.get(f"/v1/runs/{sampled}/probes?since_step={since}")["step"] == [row[0] for row in rows]


def test_series_grows_while_the_run_goes_on(daemon, name):
    daemon.create(water(), id=name, start=False)
    until(lambda: read_csv(daemon.csv(name))[1])
    assert [row[0] for row in read_csv(daemon.csv(name))[1]] == [0]
    daemon.act(name, "step", {"steps": 10})
    daemon.wait(name, "paused")
    assert read_csv(daemon.csv(name))[1][-1][0] == 10
    daemon.away(name)


def test_values_are_physical(daemon, sampled):
    columns, rows = read_csv(daemon.csv(sampled))
    first, last = (dict(zip(columns, row)) for row in (rows[0], rows[-1]))
    assert first["front"] == pytest.approx(1 - 1 / 32), "the outermost of 16 particles on 1 m"
    assert last["front"] > first["front"], "the dam breaks"
    assert (first["middle.x"], first["middle.y"]) == (0, 0)
    assert last["middle.y"] < 0
    # m g H / 2 at first
    assert first["energy.potential"] == pytest.approx(997.5 * 9.81 / 2, rel=1e-9)
    for row in rows:
        now = dict(zip(columns, row))
        parts = now["energy.kinetic"] + now["energy.strain"] + now["energy.potential"]
        assert now["energy.total"] == pytest.approx(parts, rel=1e-9)


def test_run_without_probes_has_step_and_time(daemon, name):
    scene = water(time={"end": 0.01})
    scene["probes"] = {}
    daemon.create(scene, id=name)
    daemon.wait(name, "completed")
    columns, rows = read_csv(daemon.csv(name))
    assert columns == ["step", "time"]
    assert rows[-1][0] == 10
    assert daemon.get(f"/v1/runs/{name}/probes")["probes"] == {}
    daemon.away(name)


def test_scale_and_average_apply(daemon, name):
    probes = {"cm": {"kind": "extent", "body": "pool", "axis": "x", "side": "max", "scale": 100},
              "mean": {"kind": "extent", "body": "pool", "axis": "x", "side": "max", "average": 0.02},
              "least": {"kind": "extent", "body": "pool", "axis": "y", "side": "min"},
              "floor": {"kind": "reaction", "wall": "floor"}}  # fmt: skip
    daemon.create(water(probes=probes, output={"probe_interval": 0.01}), id=name)
    daemon.wait(name, "completed")
    columns, rows = read_csv(daemon.csv(name))
    for row in rows:
        now = dict(zip(columns, row))
        assert now["cm"] == pytest.approx(100 * now["front"], rel=1e-12)
    assert now["mean"] < now["front"], "it lags behind a growing value"
    assert 0 < now["least"] < 0.1
    assert now["floor.y"] < 0, "the water's force on the floor is downward"
    daemon.away(name)
