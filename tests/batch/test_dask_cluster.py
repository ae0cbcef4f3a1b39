"""Runs whose work is done by the workers of a dask cluster."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import types
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from batch_tools import read_outputs, wait_until
from commands import run_command

from wavebatch.batch.workers import dask_cluster
from wavebatch.tools.simulate import simulate_strip

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="needs dask's: pip install distributed")

CONNECT = dask_cluster._CONNECT
_WORKER = [sys.executable, "-m", "distributed.cli.dask_worker"]
_SCHEDULER = [sys.executable, "-m", "distributed.cli.dask_scheduler"]


class Dask:
    """A scheduler and its workers, as processes of their own in a folder of their own."""

    def __init__(self, folder, *more, **env):
        """more: options of the scheduler; env: variables of all processes."""
        self.folder, self.processes, self._env = folder, [], env
        file = folder / "scheduler.json"
        self.scheduler = self._start(
            *_SCHEDULER, "--port", "0", "--no-dashboard", "--host", "127.0.0.1", "--scheduler-file", str(file), *more
        )
        wait_until(lambda: file.exists() and file.stat().st_size)
        self.address = json.loads(file.read_text())["address"]

    def client(self):
        from distributed import Client  # takes a second

        return Client(self.address, set_as_default=False)

    def start_worker(self, **env):
        return self.start_workers(1, **env)[0]

    def start_workers(self, number, **env):
        """Start them at once, and wait until the scheduler knows all: a command waits ten seconds for its first."""
        # A function of this file travels as "tests.batch.test_dask_cluster": the worker must be able to import that.
        tests = Path(__file__).parents[1]
        path = os.pathsep.join(filter(None, (str(tests.parent), str(tests), os.environ.get("PYTHONPATH"))))
        common = ("--nthreads", "1", "--no-dashboard", "--no-nanny", "--memory-limit", "0")
        workers = [self._start(*_WORKER, self.address, *common, PYTHONPATH=path, **env) for _ in range(number)]
        logs = [self.folder / f"log{self.processes.index(worker)}" for worker in workers]
        wait_until(lambda: all(b"Registered to" in log.read_bytes() for log in logs))
        return workers

    def _start(self, *command, **env):
        with open(self.folder / f"log{len(self.processes)}", "wb") as log:
            env = {**os.environ, **self._env, **env}
            process = subprocess.Popen(command, cwd=self.folder, stdout=log, stderr=log, env=env)
        self.processes.append(process)
        return process

    def stop(self):
        for process in reversed(self.processes):
            process.kill()
            process.wait()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stop()


def one_line(said, *words):
    assert said.count("\n") == 1 and all(word in said for word in words), said


@pytest.fixture(scope="module", autouse=True)
def patience():
    """On a busy machine the scheduler answers late."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dask_cluster, "_CONNECT", 100.0)
        yield


@pytest.fixture(scope="module")
def dask(tmp_path_factory):
    """A cluster of two workers that are started in another folder than the tests."""
    with Dask(tmp_path_factory.mktemp("dask")) as cluster:
        cluster.start_workers(2)
        yield cluster


@pytest.fixture(scope="module")
def strips(tmp_path_factory, edit_points):
    """Two strips, the second with two units that share packets."""
    folder = tmp_path_factory.mktemp("strips")
    simulate_strip("urban", folder / "a.las", pulses=300, seed=1)
    simulate_strip("urban", folder.parent / "b.las", pulses=47_000, seed=2)
    order = np.random.default_rng(1)
    edit_points(folder.parent / "b.las", folder / "b.las", lambda points: order.permutation(points))
    return folder


def run(*arguments):
    """Exit code and stderr of the command."""
    done = run_command("run", "--profile", "fast", *arguments)
    assert not done.stdout
    return done.exit_code, done.stderr


@pytest.mark.slow
def test_a_cluster_writes_the_same_bytes(dask, strips, tmp_path, monkeypatch):
    monkeypatch.chdir(strips.parent)
    relative = os.path.relpath(strips)
    (tmp_path / "bad").mkdir()
    broken = tmp_path / "bad" / "broken.las"
    broken.write_bytes((strips / "a.las").read_bytes()[:1000])
    assert run(relative, "-o", tmp_path / "local", "-q") == (0, "")
    code, said = run(relative, broken, "-o", tmp_path / "there", "-q", "--scheduler", dask.address)
    assert code == 3, said
    assert said.startswith(f"error: {broken}: ") and said.count("\n") == 1
    assert read_outputs(tmp_path / "there") == read_outputs(tmp_path / "local")
    skipped = run(relative, "-o", tmp_path / "there", "--scheduler", dask.address, "--resume")
    assert skipped == (0, f"{relative}/a.las: is up to date, skipped\n{relative}/b.las: is up to date, skipped\n")


@pytest.mark.slow
def test_spooled_packets_travel_through_the_output_folder(dask, strips, tmp_path):
    """What one worker puts into a temporary file, the others read; nothing of it remains."""
    from batch_tools import make_job

    from wavebatch.batch.options import RunOptions
    from wavebatch.batch.run import run_batch

    with dask.client() as client:
        client.wait_for_workers(2)
        client.run(_spool_everything)
        try:
            result = run_batch([make_job(strips / "b.las")], RunOptions(tmp_path, scheduler=dask.address))
        finally:
            made = [folder for folders in client.run(_spool_as_ever).values() for folder in folders]
    assert result.outcomes[0].error is None
    assert made and all(folder.startswith(str(tmp_path)) for folder in made)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.laz", "b.report.json"]


def _spool_everything():
    """Makes a worker spool to disk, and note where."""
    from wavebatch.files.disk import temp_store

    make, temp_store.made = temp_store.make_folder, []

    def make_folder():
        temp_store.made.append(str(make()))
        return temp_store.Path(temp_store.made[-1])

    temp_store.unwatched, temp_store.make_folder = make, make_folder
    temp_store.Spool.__init__.__kwdefaults__["kept"] = 0


def _spool_as_ever():
    """Takes that back; the folders that were made."""
    from wavebatch.files.disk import temp_store

    temp_store.make_folder = temp_store.unwatched
    temp_store.Spool.__init__.__kwdefaults__["kept"] = temp_store.SPOOL_KEPT
    return temp_store.made


@pytest.mark.quick_cases("tcp://127.0.0.1:9", "nonsense", "a:b")
@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:9", "nonsense", "foo://127.0.0.1:9", "tcp://none.invalid:8786", "tcp://", "a:b"]
)
def test_a_cluster_that_is_not_there_is_wrong_usage(strips, tmp_path, monkeypatch, address):
    monkeypatch.setattr("wavebatch.batch.workers.dask_cluster._CONNECT", 0.5)
    done = run_command("run", strips, "-o", tmp_path / "out", "--scheduler", address)
    assert done.exit_code == 2
    assert done.stderr.startswith(f"error: --scheduler {address}: cannot be reached") and done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "words"),
    [("numpy", "has numpy 1.0, this machine"), ("wavebatch", "cannot be asked")],
)
def test_workers_with_other_versions_are_refused(tmp_path, dask, package, words):
    """The worker says that it has another package, or does not find it."""
    with dask.client() as client:
        client.wait_for_workers(2)
        try:
            client.run(_pretend, package)
            code, said = run(tmp_path / "x.las", "-o", tmp_path / "out", "--scheduler", dask.address)
        finally:
            client.run(_pretend, package, kept=True)
    assert code == 2 and not (tmp_path / "out").exists()
    one_line(said, words)


def _pretend(package, kept=False):
    """Let a process have another version of numpy, or no wavebatch; kept: its own again."""
    checker = "wavebatch.batch.workers.worker_check"
    if package == "wavebatch":
        for name in (package, checker):
            sys.modules[name], sys.modules[f"kept {name}"] = sys.modules.get(f"kept {name}"), sys.modules.get(name)
        return
    from wavebatch.batch.workers import worker_check

    worker_check.numpy = np if kept else types.SimpleNamespace(__version__="1.0")
    worker_check.describe_worker.cache_clear()


@pytest.mark.slow
def test_a_scheduler_without_wavebatch_is_one_line(tmp_path, strips):
    """The scheduler finds an empty package of this name first."""
    empty = tmp_path / "empty" / "wavebatch"
    empty.mkdir(parents=True)
    (empty / "__init__.py").touch()
    with Dask(tmp_path, PYTHONPATH=str(empty.parent)) as cluster:
        cluster.start_worker()
        code, said = run(strips, "-o", tmp_path / "out", "--scheduler", cluster.address)
    assert code == 2
    one_line(said, "the scheduler cannot load wavebatch", "install the same there")


def _hold(go_on):
    """Let a worker wait at the units of strip b until the file `go_on` is there."""
    from wavebatch.batch import unit

    def wait(prepared, *arguments, solve=unit.solve_unit):
        while prepared.job.path.stem == "b" and not os.path.exists(go_on):
            time.sleep(0.05)
        return solve(prepared, *arguments)

    unit.solve_unit = wait


@pytest.mark.slow
@pytest.mark.parametrize("restarts", [False, True])
def test_a_cluster_that_dies_is_one_line_and_the_rest_can_be_resumed(tmp_path, strips, restarts):
    """Also where a new scheduler and a new worker come at the same address."""
    out = tmp_path / "out"
    with Dask(tmp_path) as cluster:
        cluster.start_worker()
        with cluster.client() as client:
            client.wait_for_workers(1)
            client.run(_hold, str(tmp_path / "never"))
        command = [sys.executable, "-W", "error", "-m", "wavebatch", "run", "--profile", "fast", "-q"]
        process = subprocess.Popen(
            [*command, str(strips), "-o", str(out), "--scheduler", cluster.address], stderr=subprocess.PIPE, text=True
        )
        wait_until(lambda: (out / "a.report.json").exists())
        cluster.stop()
        if restarts:
            port = cluster.address.rpartition(":")[2]
            cluster._start(*_SCHEDULER, "--port", port, "--no-dashboard", "--host", "127.0.0.1")
            cluster.start_worker()
        _, said = process.communicate(timeout=300)
    assert process.returncode == 3, said
    one_line(said, "the cluster is lost", "--resume")
    assert run(strips, "-o", out, "-q", "--resume") == (0, "")
    assert run(strips, "-o", tmp_path / "local", "-q") == (0, "")
    assert read_outputs(out) == read_outputs(tmp_path / "local")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")
def test_ctrl_c_is_130_and_leaves_nothing_half_written(dask, strips, tmp_path, tmp_path_factory):
    go_on = tmp_path_factory.mktemp("go") / "on"
    with dask.client() as client:
        client.wait_for_workers(2)
        client.run(_hold, str(go_on))
    command = [sys.executable, "-W", "error", "-m", "wavebatch", "run", str(strips), "--profile", "fast", "-q"]
    process = subprocess.Popen(
        [*command, "-o", str(tmp_path), "--scheduler", dask.address], stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: list(tmp_path.glob(".wavebatch-*.tmp")))
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=300)
    go_on.touch()
    assert process.returncode == 130
    assert said.startswith("interrupted") and said.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} <= {"a.laz", "a.report.json", "b.laz", "b.report.json"}


@pytest.mark.slow
def test_a_peer_that_is_no_scheduler_is_one_line_within_seconds(strips, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        command = [sys.executable, "-m", "wavebatch", "run", str(strips), "-o", str(tmp_path / "out")]
        done = subprocess.run([*command, "--scheduler", address], capture_output=True, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith(f"error: --scheduler {address}: cannot be reached")
    assert CONNECT + 0.5 <= 5


@pytest.mark.slow
def test_strips_that_a_worker_does_not_see_are_named_before_anything_starts(dask, strips, tmp_path):
    out = tmp_path / "out"
    with dask.client() as client:
        client.wait_for_workers(2)
        worker = sorted(client.nthreads())[0]
        try:
            client.run(_blind, "b.las", workers=[worker])
            code, said = run(strips, "-o", out, "--scheduler", dask.address)
            client.run(_blind, "out", workers=[worker])
            code2, said2 = run(strips, "-o", out, "--scheduler", dask.address)
        finally:
            client.run(_blind, None, workers=[worker])
    assert code == code2 == 2
    one_line(said, f"worker {worker} does not see {strips / 'b.las'}")
    one_line(said2, f"worker {worker} does not see {out};")
    assert list(out.iterdir()) == []


def _blind(part):
    """Let a worker not see what has this in its path; None: let it see everything."""
    from wavebatch.batch.workers import worker_check

    worker_check._size = lambda file: -1 if part and part in file else worker_check.os.path.getsize(file)


@pytest.mark.slow
def test_a_worker_on_another_kind_of_processor_is_refused_by_name(tmp_path, strips):
    """Other bits of sums give other surveys: 1,370, 1,371 and 1,366 echoes on one strip."""
    with Dask(tmp_path) as cluster:
        cluster.start_worker(OPENBLAS_CORETYPE="Prescott")
        code, said = run(strips, "-o", tmp_path / "out", "--scheduler", cluster.address)
    assert code == 2 and not (tmp_path / "out").exists()
    one_line(said, "has another kind of processor (", "tcp://127.0.0.1")


@pytest.mark.slow
def test_a_worker_that_joins_later_and_does_not_fit_gets_no_work(tmp_path):
    with Dask(tmp_path) as dask:
        fit = dask.start_worker()
        with dask_cluster.Cluster(dask.address, tmp_path) as cluster:
            dask.start_worker(OPENBLAS_CORETYPE="Prescott")
            cluster._client.wait_for_workers(2)
            futures = [cluster.submit(os.getpid) for _ in range(40)]
            left = list(futures)
            while left:
                left = [future for future in left if future not in cluster.wait(left)]
            assert {future.result() for future in futures} == {fit.pid}


def _meet(folder, number):
    """The process, once so many processes make this call; each notes itself in the folder."""
    (folder / str(os.getpid())).touch()
    deadline = time.monotonic() + 100
    while len(list(folder.iterdir())) < number and time.monotonic() < deadline:
        time.sleep(0.01)
    return os.getpid()


@pytest.mark.slow
def test_workers_that_join_later_take_part_and_replace_those_that_die(tmp_path, monkeypatch):
    """Calls of a worker that is gone go to the one that came, also those that dask keeps for the first."""
    monkeypatch.setattr(dask_cluster, "_POLL", 0.3)
    with Dask(tmp_path) as dask:
        first = dask.start_worker()
        with dask_cluster.Cluster(dask.address, tmp_path) as cluster:
            assert (cluster.jobs, cluster.limit) == (1, 2)
            second = dask.start_worker()
            wait_until(lambda: len(cluster._look()) == 2)
            assert (cluster.jobs, cluster.limit) == (2, 4)
            (tmp_path / "met").mkdir()
            futures = [cluster.submit(_meet, tmp_path / "met", 2) for _ in range(8)]
            assert {future.result(timeout=300) for future in futures} == {first.pid, second.pid}
            for process in first, second:
                process.kill()
                process.wait()
            left = cluster.submit(os.getpid)
            third = dask.start_worker()
            cluster.wait([left])
            assert left.result() == third.pid


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="makes a key")
def test_a_cluster_with_tls_writes_the_same_bytes(tmp_path, strips):
    """With the keys in dask's variables, as the documentation has it."""
    key, pem = tmp_path / "key.pem", tmp_path / "cert.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", key, "-out", pem, "-days", "2",
         "-subj", "/CN=wavebatch"], check=True, capture_output=True,
    )  # fmt: skip
    start = "DASK_DISTRIBUTED__COMM__TLS__"
    keys = {f"{start}{who}__{what}": str(path) for who in ("SCHEDULER", "WORKER", "CLIENT")
            for what, path in (("CERT", pem), ("KEY", key))}  # fmt: skip
    keys[f"{start}CA_FILE"] = str(pem)
    command = [sys.executable, "-m", "wavebatch", "run", str(strips / "a.las"), "--profile", "fast", "-q"]
    with Dask(tmp_path, "--protocol", "tls", **keys) as cluster:
        assert cluster.address.startswith("tls://")
        cluster.start_worker()
        far = [*command, "-o", str(tmp_path / "far"), "--scheduler", cluster.address]
        done = subprocess.run(far, env={**os.environ, **keys}, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        refused = subprocess.run(far, capture_output=True, text=True, timeout=300)
        assert refused.returncode == 2
        one_line(refused.stderr, "no certificate and key")
    subprocess.run([*command, "-o", str(tmp_path / "near")], check=True)
    assert (tmp_path / "far" / "a.laz").read_bytes() == (tmp_path / "near" / "a.laz").read_bytes()
