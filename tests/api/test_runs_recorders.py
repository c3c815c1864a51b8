"""Recorders: registration, acknowledgement, and what a run tells of them."""
from boxes import water
from fbard import until


def put(daemon, run, recorder, acked, status=200):
    return daemon.ask("PUT", f"/v1/runs/{run}/recorders/{recorder}", {"acked": acked}, status=status).json


def index(daemon, run):
    return daemon.get(f"/v1/runs/{run}/frames")


def test_registration_is_checked(daemon, name):
    daemon.create(water(), id=name, start=False)
    until(lambda: index(daemon, name)["frames"])
    path = f"/v1/runs/{name}/recorders/"
    for body, pointer in (({}, "/acked"), ({"acked": "0"}, "/acked"), ({"acked": -2}, "/acked"),
                          ({"acked": 0.5}, "/acked"), ({"acked": 1}, "/acked"), ({"acked": 1e300}, "/acked"),
                          ({"acked": 0, "name": "x"}, "/name")):  # fmt: skip
        reply = daemon.ask("PUT", path + "a", body, status=422)
        assert reply.pointers == [pointer], reply
        assert reply.fault(pointer)["expected"]
    for bad in ("%20", "-a", "a" * 65, "a:b"):
        assert daemon.request("PUT", path + bad, {"acked": -1}).status in (404, 422)
    assert index(daemon, name) and daemon.get(f"/v1/runs/{name}/recorders") == {"recorders": []}
    assert put(daemon, name, "a", -1)["acked"] == -1
    reply = put(daemon, name, "a", 0)
    assert (reply["acked"], reply["lag_frames"], reply["lag_bytes"], reply["first"]) == (0, 0, 0, 0)
    reply = put(daemon, name, "a", -1)
    assert reply["lag_frames"] == 1 and reply["lag_bytes"] == index(daemon, name)["frames"][0]["bytes"]
    daemon.ask("PUT", "/v1/runs/none/recorders/a", {"acked": -1}, status=404)
    for bad, pointers in (("x", ["/recorders"]), (["a"] * 65, ["/recorders"]), (["a b"], ["/recorders/0"]),
                          (["a", 1, "b", ""], ["/recorders/1", "/recorders/3"])):  # fmt: skip
        reply = daemon.ask("POST", "/v1/runs", {"scene": water(), "recorders": bad}, status=422)
        assert reply.pointers == pointers, reply
    daemon.away(name)


def test_recorders_come_with_the_run_and_are_told_in_their_order(daemon, name):
    made = daemon.create(water(), id=name, recorders=["second", "first"])
    assert [(r["name"], r["acked"]) for r in made["recorders"]] == [("second", -1), ("first", -1)]
    run = daemon.wait(name, "completed")
    n = len(index(daemon, name)["frames"])
    assert run["journal"]["frames"] == n and run["journal"]["first"] == 0 and run["journal"]["bytes"] > 0
    assert put(daemon, name, "first", n - 1)["lag_frames"] == 0
    assert put(daemon, name, "third", n - 3)["lag_frames"] == 2
    told = daemon.get(f"/v1/runs/{name}/recorders")["recorders"]
    assert [(r["name"], r["acked"]) for r in told] == [("second", -1), ("first", n - 1), ("third", n - 3)]
    assert told[0]["lag_bytes"] == sum(f["bytes"] for f in index(daemon, name)["frames"])
    left = daemon.ask("DELETE", f"/v1/runs/{name}/recorders/second").json["recorders"]
    assert [r["name"] for r in left] == ["first", "third"]
    daemon.ask("DELETE", f"/v1/runs/{name}/recorders/second", status=404)
    daemon.away(name)
    daemon.ask("GET", f"/v1/runs/{name}/recorders", status=404)


def test_recorders_outlive_a_restart_and_are_64_at_most(fresh):
    d = fresh().start()
    run = d.create(water(), recorders=[f"r{k}" for k in range(64)])["id"]
    d.wait(run, "completed")
    d.ask("PUT", f"/v1/runs/{run}/recorders/more", {"acked": -1}, status=409)
    put(d, run, "r7", 3)
    d.kill()
    d.start()
    told = d.run(run)["recorders"]
    assert [r["name"] for r in told] == [f"r{k}" for k in range(64)]
    assert told[7]["acked"] in (-1, 3)
    put(d, run, "r7", 10)
