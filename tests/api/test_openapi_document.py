"""The OpenAPI document: true of every route, and of every answer that this session's tests were given."""
import http.client
import json
import re
import socket

import jsonschema
import pytest
from boxes import water
from fbard import EXCHANGES, PATIENCE

# Contract, section 2; what issue 2 asks for.
ROUTES = {
    "/healthz": {"get"}, "/readyz": {"get"}, "/openapi.json": {"get"}, "/v1": {"get"},
    "/v1/schemas/scene.json": {"get"}, "/v1/materials": {"get"}, "/v1/scenes": {"get"}, "/v1/scenes/{name}": {"get"},
    "/v1/scenes:validate": {"post"}, "/v1/runs": {"get", "post"}, "/v1/runs/{id}": {"get", "delete"},
    "/v1/runs/{id}:start": {"post"}, "/v1/runs/{id}:pause": {"post"}, "/v1/runs/{id}:resume": {"post"},
    "/v1/runs/{id}:step": {"post"}, "/v1/runs/{id}:cancel": {"post"}, "/v1/runs/{id}:checkpoint": {"post"},
    "/v1/runs/{id}:snapshot": {"post"}, "/v1/runs/{id}/config": {"get", "patch"}, "/v1/runs/{id}/scene": {"get"},
    "/v1/runs/{id}/probes": {"get"}, "/v1/runs/{id}/frames": {"get"}, "/v1/runs/{id}/frames/{seq}": {"get"},
    "/v1/runs/{id}/events": {"get"}, "/v1/runs/{id}/stream": {"get"}, "/metrics": {"get"},
    "/": {"get"}, "/page/{file}": {"get"}, "/v1/events": {"get"}, "/v1/runs/{id}/changes": {"get"}, "/v1/runs/{id}/recorders": {"get"}, "/v1/runs/{id}/recorders/{name}": {"put", "delete"},
}  # fmt: skip
METHODS = ("get", "post", "put", "patch", "delete", "head", "options", "trace")


@pytest.fixture(scope="module")
def document(daemon):
    return daemon.get("/openapi.json")


def names_of(template):
    return re.sub(r"\{[^}]*\}", "{}", template)


def operations(document):
    for path, item in document["paths"].items():
        for method, operation in item.items():
            if method in METHODS:
                yield path, method, operation


def resolve(document, node):
    while "$ref" in node:
        target = document
        for part in node["$ref"].removeprefix("#/").split("/"):
            target = target[part.replace("~1", "/").replace("~0", "~")]
        node = target
    return node


def test_document_is_openapi_3_1(document):
    assert document["openapi"].startswith("3.1.")
    assert document["info"]["title"] and document["info"]["version"]
    for path, method, operation in operations(document):
        where = f"{method} {path}"
        assert operation.get("responses"), where
        declared = {p["name"] for p in map(lambda p: resolve(document, p),
                    operation.get("parameters", []) + document["paths"][path].get("parameters", []))
                    if p["in"] == "path"}  # fmt: skip
        assert declared == set(re.findall(r"\{([^}]*)\}", path)), where
        for status, response in operation["responses"].items():
            response = resolve(document, response)
            assert re.fullmatch(r"[1-5](\d\d|XX)|default", status), where
            assert response["description"], where
            for media in response.get("content", {}).values():
                jsonschema.Draft202012Validator.check_schema(media.get("schema", {}))
    names = [o["operationId"] for _, _, o in operations(document) if "operationId" in o]
    assert len(names) == len(set(names))


def test_document_has_every_route_of_the_contract(document):
    there = {}
    for path, method, _ in operations(document):
        there.setdefault(names_of(path), set()).add(method)
    for path, methods in ROUTES.items():
        assert methods <= there.get(names_of(path), set()), path


def test_references_within_the_document_lead_somewhere(document):
    def walk(node):
        if isinstance(node, dict):
            if isinstance(node.get("$ref"), str) and node["$ref"].startswith("#"):
                resolve(document, {"$ref": node["$ref"]})
            for value in node.values():
                walk(value)
        elif isinstance(node, list):
            for value in node:
                walk(value)

    walk(document)


def head_of(daemon, method, path, body=None):
    """Status of an answer whose body may never end."""
    connection = http.client.HTTPConnection(daemon.host, timeout=PATIENCE)
    try:
        headers = {"Content-Type": "application/json"} if body is not None else {}
        connection.request(method, path, body, headers)
        return connection.getresponse().status
    finally:
        connection.close()


def test_every_route_of_the_document_answers(daemon, document):
    run = daemon.create(water(time={"end": 0.005}))["id"]
    daemon.wait(run, "completed")
    for path, method, operation in operations(document):
        url = path.replace("{id}", run).replace("{seq}", "0").replace("{name}", "dam-break").replace("{file}", "page.css")
        assert "{" not in url, path
        if method == "delete" and path == "/v1/runs/{id}":
            continue
        body = b"{}" if method in ("post", "put", "patch") else None
        status = head_of(daemon, method.upper(), url, body)
        assert status not in (404, 405, 501) or (status == 404 and method == "delete"), (method, path, status)
        assert any(s in operation["responses"] for s in (str(status), f"{status // 100}XX", "default")), (
            f"{method} {path}: {status} is not declared")  # fmt: skip
    daemon.away(run)


def test_methods_that_the_document_lacks_are_405(daemon, document):
    run = daemon.create(water(time={"end": 0.005}))["id"]
    daemon.wait(run, "completed")
    allowed = {}
    for path, method, _ in operations(document):
        allowed.setdefault(path, set()).add(method.upper())
    for path, methods in allowed.items():
        url = path.replace("{id}", run).replace("{seq}", "0").replace("{name}", "dam-break").replace("{file}", "page.css")
        for method in {"GET", "POST", "PUT", "PATCH", "DELETE"} - methods:
            reply = daemon.ask(method, url, status=405)
            assert methods <= {m.strip() for m in reply.headers["allow"].split(",")}, reply
    daemon.away(run)


def test_socket_is_closed_after_an_idle_connection_asks_nothing(daemon):
    """An idle connection is open at first: it may be reused."""
    address, port = daemon.host.split(":")
    with socket.create_connection((address, int(port)), timeout=PATIENCE) as s:
        ask = f"GET /healthz HTTP/1.1\r\nHost: {daemon.host}\r\n\r\n".encode()
        for _ in range(2):
            s.sendall(ask)
            answer = http.client.HTTPResponse(s)
            answer.begin()
            assert answer.status == 200 and answer.read()


JUNK = [None, True, False, -1, 0, 1, 1.5, 2**60, "", "a", "with a blank", "x" * 64, "x" * 65, [], ["a"], ["a", "b c"], ["a"] * 65, [1], {}, {"a": 1}]


def bodies(keys):
    """Each key with each junk value, alone and beside the other keys; and a key that there is not."""
    yield {}
    yield {"nothing_of_the_kind": 1}
    for key in keys:
        for value in JUNK:
            yield {key: value}
            yield {**keys, key: value}


def says(document, path, method):
    """What the document says of a body: a function that tells whether it is valid."""
    schema = document["paths"][path][method]["requestBody"]["content"]["application/json"]["schema"]
    return jsonschema.Draft202012Validator({**schema, "components": document["components"]}).is_valid


@pytest.mark.parametrize("path, method, keys, exact", [
    ("/v1/runs/{id}:step", "post", {"steps": 1}, True),
    ("/v1/runs/{id}:step", "post", {"until": 1.0}, True),
    ("/v1/runs/{id}:pause", "post", {}, True),
    ("/v1/runs/{id}/recorders/{name}", "put", {"acked": -1}, False),  # a number beyond the frames there are is refused too
    ("/v1/runs/{id}/config", "patch", {"fbar": True, "damping": {"local": 0.1}, "output": {"every_steps": 5}, "gravity": [0, -1],
                                       "time": {"end": 1}, "transfer": {"blend": 1}}, False),
    ("/v1/runs", "post", {"scene": "dam-break", "overrides": {}, "id": "a-name", "start": False, "wait_subscribers": 3,
                          "recorders": ["a"]}, False),
    ("/v1/scenes:validate", "post", {"scene": "dam-break", "overrides": {}}, False),
])  # fmt: skip
def test_bodies_are_refused_where_the_document_says(daemon, document, path, method, keys, exact):
    """What it does not allow is a 422, and what it allows is none where the schema says all that there is to say."""
    run = daemon.create(water(), start=False)["id"]
    if exact:
        daemon.act(run, "cancel")  # then what is sound is a 409
    valid = says(document, path, method)
    url, refused = path.replace("{id}", run).replace("{name}", "somebody"), 0
    for body in bodies(keys):
        if path == "/v1/runs" and valid(body):
            continue  # other tests create runs
        status = daemon.request(method.upper(), url, body).status
        if valid(body):
            assert (status in (200, 409)) if exact else status in (200, 409, 422), (body, status)
        else:
            assert status == 422, (body, status)
            refused += 1
    assert refused > 0
    daemon.away(run)


# ---- Keep this last: it needs the answers to all other tests. ----


def test_every_answer_of_this_session_is_as_declared(daemon, document):
    patterns = []
    for path, method, operation in operations(document):
        pattern = re.sub(r"\\\{[^}]*\\\}", "[^/:]+", re.escape(path))
        patterns.append((re.compile(pattern + r"(\?.*)?"), path, method, operation))
    # What has no parameter is looked at first: /v1/runs/{id} is no scene's schema.
    patterns.sort(key=lambda p: p[1].count("{"))
    resolver = jsonschema.RefResolver.from_schema(document)
    validators, counts, wrong = {}, {}, {}
    for reply in EXCHANGES:
        for pattern, path, method, operation in patterns:
            if method.upper() == reply.method and pattern.fullmatch(reply.path):
                break
        else:
            continue  # a route or method that there is not
        key = (path, method, reply.status)
        counts[key] = counts.get(key, 0) + 1
        response = next((operation["responses"][s] for s in
                         (str(reply.status), f"{reply.status // 100}XX", "default") if s in operation["responses"]),
                        None)  # fmt: skip
        if response is None:
            wrong[key] = "status not declared"
            continue
        content = resolve(document, response).get("content", {})
        if reply.body and reply.type not in content:
            wrong[key] = f"type {reply.type} not declared"
        elif reply.body and reply.type.endswith("json"):
            if key not in validators:
                schema = content[reply.type].get("schema", {})
                validators[key] = jsonschema.Draft202012Validator(schema, resolver=resolver)
            try:
                error = jsonschema.exceptions.best_match(validators[key].iter_errors(reply.json))
            except (AssertionError, ValueError) as no_json:
                wrong[key] = f"{no_json}: {reply.path}"
                continue
            if error is not None:
                wrong[key] = f"{error.json_path}: {error.message[:300]}"
    assert counts
    assert not wrong, json.dumps({str(k): v for k, v in wrong.items()}, indent=1)
