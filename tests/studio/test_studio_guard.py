"""What the studio refuses, whoever asks: hosts, origins, tokens, paths, sizes."""

import http.client
import json
import os
import re
import signal
import subprocess
import sys
import time
from urllib.parse import urlsplit

import pytest

from rlftsim.errors import ConfigError
from rlftsim.studio.guard import Access
from rlftsim.studio.server import Studio, create_app, load_token, static_files, static_hash

HOST = "127.0.0.1:4711"
READS = ["/", f"/static/{static_hash()}/main.js", "/api/session", "/api/scenarios?split=validation", "/api/runs/x"]
CHANGES = ["/api/runs", "/api/goals/save", "/api/goals/check", "/api/goals/open", "/api/export", "/api/runs/x/cancel"]


@pytest.mark.parametrize("path", READS)
def test_nothing_is_read_without_the_token_or_under_a_foreign_host(client, access, path):
    assert client.get(path, {"cookie": None}).status_code == 401
    assert client.get(path, {"cookie": f"{access.cookie}={'x' * 43}"}).status_code == 401
    assert client.get(path, {"cookie": f"other={access.token}"}).status_code == 401
    for host in ("evil.example:4711", "127.0.0.1", "127.0.0.1:80", "localhost.evil.example:4711", ""):
        assert client.get(path, {"host": host}).status_code == 403
    for host in ("localhost:4711", "[::1]:4711", "LOCALHOST:4711"):
        assert client.get(path, {"host": host}).status_code in (200, 404)
    assert client.get(path, {"cookie": None, "authorization": f"Bearer {access.token}"}).status_code in (200, 404)


@pytest.mark.parametrize("other", ['theme={"dark": 1}', "list[0]=1", "name=\u00e9", "a b c", 'x="unclosed'])
def test_cookies_of_other_programs_on_this_host_do_not_hide_the_token(client, access, other):
    both = f"{other}; {access.cookie}={access.token}; {other}"
    assert client.get("/api/alive", {"cookie": both.encode()}).status_code == 200


def test_a_trusted_host_may_be_written_in_any_case(client, session, worker):
    access = Access(4711, "t" * 43, trusted_hosts=("Hub.Example",))
    hub = type(client)(create_app(session, worker, access), access)
    assert hub.get("/api/alive", {"host": "hub.example"}).status_code == 200
    assert hub.get("/api/alive", {"host": "hub.example:1"}).status_code == 403


@pytest.mark.parametrize("path", CHANGES)
def test_nothing_is_changed_from_another_page(client, access, path):
    for origin in (
        "http://evil.example",
        "null",
        f"http://{HOST}.evil.example",
        "http://127.0.0.1:80",
        "http://[::1",
        None,
    ):
        assert client.post(path, {}, {"origin": origin}).status_code == 403
    # a bearer that is not the token stands in for no origin, even beside the right cookie
    assert client.post(path, {}, {"origin": None, "authorization": "Bearer x"}).status_code == 403
    assert client.post(path, {}, {"cookie": None}).status_code == 401
    assert client.post(path, {}, {"content-type": "text/plain"}).status_code == 415
    assert client.request("DELETE", "/api/runs/x", {"origin": "http://evil.example"}).status_code == 403
    script = {"cookie": None, "origin": None, "authorization": f"Bearer {access.token}"}
    assert client.post(path, {}, script).status_code in (404, 422, 200)


def test_the_token_of_the_address_becomes_a_cookie_and_leaves_the_address(client, access):
    answer = client.get(f"/?token={access.token}", {"cookie": None})
    assert (answer.status_code, answer.headers["location"]) == (303, "./")
    assert answer.headers["set-cookie"] == f"{access.cookie}={access.token}; HttpOnly; SameSite=Strict; Path=/"
    assert client.get("/?token=wrong", {"cookie": None}).status_code == 401
    assert client.get(f"/api/session?token={access.token}", {"cookie": None}).status_code == 401


def test_every_answer_forbids_foreign_code_frames_and_sniffing(client):
    for path in (*READS, "/nothing"):
        headers = client.get(path).headers
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in headers
    assert "immutable" in client.get(READS[1]).headers["cache-control"]
    assert client.get("/api/session").headers["cache-control"] == "no-store"


def test_a_body_of_two_megabytes_is_refused(client):
    body = json.dumps({"text": "x" * (2 << 20)})
    assert client.request("POST", "/api/goals/open", content=body).status_code == 413


@pytest.mark.parametrize("path", ["..%2fsession.py", "%2e%2e%2fguard.py", "..", "index.html", "none.js"])
def test_static_files_are_looked_up_by_name(client, path):
    assert client.get(f"/static/{static_hash()}/{path}").status_code == 404


@pytest.mark.parametrize("name", ["..", ".", "../x", "a/b", "%2e%2e", "", "x" * 81, "a\x00b", "a b"])
def test_names_that_are_paths_write_nothing(client, session, name):
    text = '{"format": "rlftsim-goals-1", "goals": []}'
    before = sorted(session.out.parent.rglob("*"))
    for path, body in (("/api/goals/save", {"text": text}), ("/api/export", {"kind": "scores", "run": "x"})):
        answer = client.post(path, {"name": name, **body})
        # two names are those of hidden files at worst, below the folder; the run does not exist
        assert answer.status_code in (403, 404, 422) or name in ("..", ".")
    after = set(sorted(session.out.parent.rglob("*"))) - set(before)
    assert all(session.out in file.parents for file in after)


@pytest.mark.parametrize("name", ["..", "."])
def test_a_folder_of_rollouts_is_never_the_folder_of_exports_or_the_one_above(client, session, name):
    state = client.finished(split="validation", scenario="9d639de83d6f5239", models=["demo-base"], num_rollouts=1)
    answer = client.post("/api/export", {"kind": "rollouts", "name": name, "run": state["run"], "replace": True})
    written = [*session.out.glob("*.npz"), *session.out.parent.glob("*.npz")]
    assert (answer.status_code, written) == (403, [])


def test_a_symbolic_link_does_not_lead_out_of_the_folder(client, session, tmp_path):
    text = '{"format": "rlftsim-goals-1", "goals": []}'
    session.out.mkdir(exist_ok=True)
    (session.out / "linked.json").symlink_to(tmp_path / "outside.json")
    (session.out / "folder").symlink_to(tmp_path)
    answer = client.post("/api/goals/save", {"name": "linked", "text": text, "replace": True})
    assert (answer.status_code, (tmp_path / "outside.json").exists()) == (403, False)
    state = client.finished(split="validation", scenario="9d639de83d6f5239", models=["demo-base"], num_rollouts=1)
    answer = client.post("/api/export", {"kind": "rollouts", "name": "folder", "run": state["run"], "replace": True})
    assert (answer.status_code, list(tmp_path.iterdir())) == (403, [])


def test_a_rebound_name_is_refused_over_a_real_socket(session):
    with Studio(session) as studio:
        for host, status in ((f"evil.example:{studio.port}", 403), (f"127.0.0.1:{studio.port}", 200)):
            connection = http.client.HTTPConnection("127.0.0.1", studio.port)
            cookie = f"{studio.access.cookie}={studio.access.token}"
            connection.request("GET", "/api/session", headers={"Host": host, "Cookie": cookie})
            assert connection.getresponse().status == status
            connection.close()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no second loopback address")
def test_the_printed_address_answers_on_another_interface(session):
    with Studio(session, host="127.0.0.2") as studio:
        address = urlsplit(studio.url)
        connection = http.client.HTTPConnection(address.netloc)
        connection.request("GET", f"{address.path}?{address.query}")
        answer = connection.getresponse()
        assert (answer.status, studio.access.cookie in (answer.headers["set-cookie"] or "")) == (303, True)
        connection.close()


def test_the_page_has_no_inline_code_and_never_sets_html(client):
    text = "".join(content.decode() for name, content in static_files().items() if name.endswith((".js", ".html")))
    assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function|https?://", text)
    assert not re.search(r"<script(?![^>]*src=)|\son\w+=\"|style=\"", static_files()["index.html"].decode())


def test_a_token_file_is_made_private_and_read_again(tmp_path):
    path = tmp_path / "token"
    token = load_token(path)
    assert (load_token(path), path.stat().st_mode & 0o777) == (token, 0o600)
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="only its owner"):
        load_token(path)
    path.write_bytes(b"\xff" * 60)
    path.chmod(0o600)
    with pytest.raises(ConfigError, match="only its owner"):
        load_token(path)


def test_what_cannot_be_served_or_saved_is_refused_at_the_start(tmp_path, capsys):
    from rlftsim.cli.main import main

    words = ["studio", "--no-browser", "--model", "constant_velocity"]
    (tmp_path / "file").touch()
    assert main([*words, "--port", "65536"]) == 2
    assert main([*words, "--out", str(tmp_path / "file")]) == 2
    port, out = capsys.readouterr().err.splitlines()
    assert "--port must lie between 0 and 65535, got 65536" in port
    assert f"{tmp_path / 'file'} is a file" in out


def test_the_error_names_the_flag_that_is_wrong(session):
    with Studio(session) as first, pytest.raises(ConfigError, match="choose another --port, or 0"):
        Studio(session, port=first.port)
    for host in ("192.0.2.7", "no.such.name.invalid"):
        with pytest.raises(ConfigError, match=r"cannot listen on .*: choose another --host\."):
            Studio(session, host=host)


def test_another_host_needs_a_word_more(capsys):
    from rlftsim.cli.main import main

    assert main(["studio", "--host", "0.0.0.0", "--no-browser"]) == 2
    assert "--allow-remote" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_prints_its_address_and_ends_within_two_seconds_while_it_simulates(tmp_path):
    words = [sys.executable, "-m", "rlftsim", "studio", "--no-browser", "--json", "--out", str(tmp_path / "out")]
    begun = time.monotonic()
    started = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ)
    try:
        about = json.loads(started.stdout.readline())
        begin_s = time.monotonic() - begun
        token = about["url"].partition("token=")[2]
        connection = http.client.HTTPConnection("127.0.0.1", about["port"])
        body = {
            "split": "validation",
            "scenario": "9d639de83d6f5239",
            "models": ["demo-goals"],
            "num_rollouts": 128,
            "seed": 5,
        }
        headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
        connection.request("POST", "/api/runs", json.dumps(body), headers)
        assert connection.getresponse().status == 200
        time.sleep(0.5)
        before = time.monotonic()
        started.send_signal(signal.SIGINT)
        started.wait(timeout=20)
        end_s = time.monotonic() - before
        print(json.dumps({"begin_s": round(begin_s, 2), "end_s": round(end_s, 2)}))
        # Three and two seconds where nothing else computes; the simulation itself would take much longer than this.
        slowness = max(2.0, os.getloadavg()[0])
        assert begin_s < 10 * slowness
        assert end_s < 4 * slowness
        assert "Traceback" not in started.stderr.read()
    finally:
        started.kill()
        started.communicate()
