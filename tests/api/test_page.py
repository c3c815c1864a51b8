"""The live page as files, and what the API has for it: events of all runs, frames cut to size."""
import re
import threading

import pytest
from boxes import WATER_PARTICLES, endless, water
from fbard import PATIENCE, until
from frames import Frame, picked
from test_watching import Stream


def page_files(daemon):
    """All that the page loads, found as a browser finds it: {path: Reply}."""
    found, wanted = {}, ["/"]
    while wanted:
        path = wanted.pop()
        if path in found:
            continue
        reply = found[path] = daemon.ask("GET", path)
        text = reply.body.decode()
        if reply.type == "text/html":
            wanted += re.findall(r'(?:src|href)="(/[^"]*)"', text)
        elif reply.type == "text/javascript" and "chart" not in path:
            wanted += ["/page/" + name for name in re.findall(r'from "\./([^"]+)"', text)]
    return found


def test_page_is_whole_and_types_are_right(daemon):
    types = {"css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
    found = page_files(daemon)
    assert found["/"].type == "text/html" and len(found) > 10
    for path, reply in found.items():
        if path != "/":
            assert reply.type == types[path.rsplit(".")[-1]], path
        assert reply.headers["x-content-type-options"] == "nosniff"


def test_page_is_under_a_policy_that_lets_in_nothing_else(daemon):
    for path, reply in page_files(daemon).items():
        policy = dict(part.strip().split(" ", 1) for part in reply.headers["content-security-policy"].split(";"))
        assert policy["default-src"] == "'none'", path
        for key in ("script-src", "style-src", "connect-src", "img-src"):
            assert policy[key] == "'self'", (path, key)
        for key in ("base-uri", "form-action", "frame-ancestors"):
            assert policy[key] == "'none'", (path, key)
        assert reply.headers["referrer-policy"] == "no-referrer"
        # What the policy would stop is not there either.
        text = reply.body.decode()
        if reply.type == "text/html":
            assert not re.search(r"<script(?![^>]*src=)|<style|\son[a-z]+=|\sstyle=|https?://", text)
        elif "chart" not in path and reply.type != "image/svg+xml":
            assert "http://" not in text and "https://" not in text, path


def test_page_is_kept_by_browsers_until_it_changes(daemon):
    reply = daemon.ask("GET", "/page/main.js")
    assert reply.headers["cache-control"] == "no-cache"
    tag = reply.headers["etag"]
    again = daemon.ask("GET", "/page/main.js", headers={"If-None-Match": f'"other", {tag}'}, status=304)
    assert again.body == b"" and again.headers["etag"] == tag
    assert daemon.ask("GET", "/page/main.js", headers={"If-None-Match": '"other"'}).body == reply.body
    assert daemon.ask("GET", "/page/page.css").headers["etag"] != tag


def test_page_has_no_other_files(daemon):
    for path in ("/page/", "/page/nothing.js", "/page/..%2fpage.css", "/index.html"):
        daemon.ask("GET", path, status=404)


def test_page_asks_for_no_token_but_tells_nothing(fresh, tmp_path):
    token = tmp_path / "token"
    token.write_text("open-sesame\n")
    token.chmod(0o600)
    d = fresh("--token-file", str(token)).start()
    page_files(d)
    for path in ("/v1", "/v1/runs", "/v1/events", "/metrics", "/page", "/page/../v1"):
        assert d.request("GET", path).status == 401, path
    assert d.request("GET", "/", headers={"Host": "elsewhere.example"}).status == 421
    assert d.request("GET", "/", headers={"Origin": "http://elsewhere.example"}).status == 403
    d.token = "open-sesame"
    assert d.get("/v1/runs") == {"runs": []}


# ---- Events of all runs ----


def test_events_of_all_runs_begin_with_each_run(daemon, name):
    ids = [name + "a", name + "b"]
    for k in ids:
        daemon.create(water(), id=k, start=False)
    with Stream(daemon, "/v1/events") as stream:
        seen = {}
        for _, kind, data in stream.events():
            if kind == "ready":
                break
            assert kind == "run"
            seen[data["id"]] = data
        for k in ids:
            there = daemon.get(f"/v1/runs/{k}")
            assert seen[k].keys() == there.keys()
            assert (seen[k]["state"], seen[k]["step"]) == ("paused", 0)
    daemon.away(*ids)


def test_events_of_all_runs_tell_of_creation_states_and_removal(daemon, name):
    with Stream(daemon, "/v1/events") as stream:
        events = ((kind, data) for _, kind, data in stream.events() if kind == "ready" or data.get("id") == name)
        for kind, _ in events:
            if kind == "ready":
                break
        daemon.create(water(time={"end": 0.05}), id=name, start=False)
        states = []
        steps = []
        for kind, data in events:
            if kind == "gone":
                break
            steps.append(data["step"])
            if states[-1:] != [data["state"]]:
                states.append(data["state"])
                if states[-1] == "paused":
                    daemon.act(name, "start")
                elif states[-1] == "completed":
                    daemon.ask("DELETE", f"/v1/runs/{name}", status=204)
        # How often it is looked at is the daemon's: short states may be passed over, never the order. On a slow disk
        # running is waiting now and then.
        states = [s for k, s in enumerate(states) if s != "waiting" and s not in states[:k]]
        order = [s for s in ("queued", "paused", "running", "completed") if s in states]
        assert states == order and states[-1] == "completed" and "paused" in states
        assert steps == sorted(steps) and steps[-1] == 50


def test_events_of_all_runs_tell_of_a_switched_fbar(daemon, name):
    daemon.create(endless(), id=name, start=False)
    with Stream(daemon, "/v1/events") as stream:
        events = (data for _, kind, data in stream.events() if kind == "run" and data["id"] == name)
        before = next(events)["fbar"]
        daemon.ask("PATCH", f"/v1/runs/{name}/config", {"fbar": not before})
        assert next(e for e in events if e["fbar"] != before)["changes"][-1]["patch"] == {"fbar": not before}
    daemon.away(name)


def test_events_of_all_runs_end_when_the_daemon_does(fresh):
    d = fresh().start()
    with Stream(d, "/v1/events") as stream:
        events = stream.events()
        assert next(events)[1] == "ready"
        d.process.terminate()
        assert next(events)[1:] == ("end", {"event": "end", "reason": "stopping"})
        assert list(events) == []
    d.process.wait(PATIENCE)
    assert d.process.returncode == 0
    d.process = None


def test_events_of_all_runs_say_nothing_while_nothing_happens(fresh):
    """Nothing but the heartbeat, and next to no work: what a page that stands still costs."""
    d = fresh().start()
    d.create(water(), id="still", start=False)
    d.settle("still")
    with Stream(d, "/v1/events") as stream:
        events = stream.events()
        assert [next(events)[1] for _ in range(2)] == ["run", "ready"]
        stream.answer.fp.raw._sock.settimeout(3)
        with pytest.raises(TimeoutError):
            next(events)


# ---- Frames cut to size ----


@pytest.mark.parametrize("query, stride, fields", [
    ("max_particles=100", 3, None),
    ("fields=position,mean_stress", 1, {"position", "mean_stress"}),
    ("max_particles=1&fields=velocity", WATER_PARTICLES, {"velocity"}),
    ("fields=plastic_strain", 1, set()),  # a field that there is, but not in this frame
])  # fmt: skip
def test_frame_is_cut_to_what_is_asked(daemon, name, query, stride, fields):
    daemon.create(water(time={"end": 0.02}), id=name)
    daemon.wait(name, "completed")
    whole = Frame(daemon.frame(name, "0"))
    reply = daemon.ask("GET", f"/v1/runs/{name}/frames/0?{query}")
    cut = Frame(reply.body)
    assert reply.headers["fbard-seq"] == "0"
    assert set(cut.fields) == (set(whole.fields) if fields is None else fields)
    assert all(cut.units[field] == whole.units[field] for field in cut.fields)
    rows = picked(cut, whole, stride) if cut.fields else []
    assert cut.header["time"] == whole.header["time"] and cut.header["count"] == -(-WATER_PARTICLES // stride)
    if "position" in cut.fields and stride > 1:
        assert len({row % stride for row in rows}) > 1, "no stripes: not always the k-th"
        last = [Frame(daemon.frame(name, f"latest{q}")) for q in (f"?{query}", "")]
        assert picked(*last, stride) == rows, "the same particles in every frame"
    with Stream(daemon, f"/v1/runs/{name}/stream?{query}") as stream:
        (block,) = stream.frames()
    assert block == daemon.ask("GET", f"/v1/runs/{name}/frames/latest?{query}").body
    daemon.away(name)


@pytest.mark.parametrize("query", ["fields=", "fields=position,nothing", "fields=position,", "max_particles=0"])
def test_frame_cut_to_nonsense_is_refused(daemon, name, query):
    daemon.create(water(), id=name, start=False)
    for path in ("frames/0", "stream"):
        daemon.ask("GET", f"/v1/runs/{name}/{path}?{query}", status=400)
    daemon.away(name)


def test_index_of_frames_goes_on_after_a_frame(daemon, name):
    daemon.create(water(time={"end": 0.05}), id=name)
    daemon.wait(name, "completed")
    every = daemon.get(f"/v1/runs/{name}/frames")
    for since in (0, 2, len(every["frames"]) - 1, 10**6):
        part = daemon.get(f"/v1/runs/{name}/frames?since_seq={since}")
        assert part["frames"] == [f for f in every["frames"] if f["seq"] > since]
        assert part["first"] == every["first"]
    daemon.ask("GET", f"/v1/runs/{name}/frames?since_seq=x", status=400)
    daemon.away(name)


# ---- What viewers cost ----


@pytest.mark.long
def test_eight_viewers_and_a_stalled_one_cost_little_and_block_nothing(fresh):
    """12,800 particles, some 60 frames, 8 streams thinned as the page thins, one that is never read; the events of all
    runs besides. Measured on the daemon's own process, against the same run unwatched."""
    d = fresh(slots=1, threads=1).start()
    overrides = {"cell": 0.125, "time": {"end": 0.001, "dt": 2e-5}, "output": {"interval": 0.001}}
    cost, probes, waited, sent = {}, {}, {}, {}
    for run, viewers in (("warm", 0), ("alone", 0), ("watched", 8)):
        d.create("dam-break", id=run, overrides=overrides, start=False)
        until(lambda: d.frames(run))
        query = "max_particles=5000&fields=position,mean_stress"
        streams = [Stream(d, f"/v1/runs/{run}/stream?{query}") for _ in range(viewers)]
        stalled = [Stream(d, f"/v1/runs/{run}/stream") for _ in range(viewers > 0)]
        stalled += [Stream(d, "/v1/events") for _ in range(viewers > 0)]
        got = [0] * viewers

        def read(k):
            for _ in streams[k].frames():
                got[k] += 1

        readers = [threading.Thread(target=read, args=(k,)) for k in range(viewers)]
        before = d.cpu_seconds()
        for thread in readers:
            thread.start()
        d.act(run, "start")
        end = d.wait(run, "completed")
        cost[run] = d.cpu_seconds() - before
        waited[run] = end["performance"]["phases"]["waiting"]
        probes[run] = d.get(f"/v1/runs/{run}/probes")
        for thread in readers:
            thread.join()
        for stream in stalled:
            stream.connection.close()
            stream.answer.close()
        assert all(n > 5 for n in got)
        sent[run] = sum(got)
    more = cost["watched"] - cost["alone"]
    print(f"\nCPU alone {cost['alone']:.2f} s, with 8 viewers and a stalled one {cost['watched']:.2f} s: "
          f"{1000 * more / sent['watched']:.2f} ms for each of {sent['watched']} frames")  # fmt: skip
    assert probes["alone"] == probes["watched"]
    assert waited == {"warm": 0, "alone": 0, "watched": 0}, "no step waits for a viewer"
    # To cut 12,800 particles to 4,267 with two fields, digest and send them takes about 1 ms; twice that is allowed, and
    # a tenth of the run, by which two equal runs differ on a busy machine.
    assert more < 0.002 * sent["watched"] + 0.1 * cost["alone"], cost
