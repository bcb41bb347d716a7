"""A Slurm of one machine: munged, slurmctld and slurmd on loopback, all of their files in one folder, ended with the
`with` block, and by the kernel where this process is killed."""

from __future__ import annotations

import contextlib
import ctypes
import os
import re
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scontrol", "scancel", "sinfo")
SEARCH = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin"])
START_SECONDS = 30.0
SET_PARENT_DEATH_SIGNAL = 1  # prctl(2)

CONFIGURATION = """
ClusterName=ltsh
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller_port}
SlurmdPort={node_port}
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket,cred_expire=10
SlurmUser={user}
SlurmdUser={user}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/pgid
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
JobCompType=jobcomp/filetxt
JobCompLoc={folder}/completed.txt
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
SchedulerType=sched/builtin
ReturnToService=2
MinJobAge=600
KillWait=5
PropagateResourceLimits=NONE
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=1000 State=UNKNOWN
PartitionName=farm Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


def missing_programs() -> list[str]:
    return [name for name in PROGRAMS if shutil.which(name, path=SEARCH) is None]


class Cluster:
    """Slurm's commands, for the cluster in `folder`."""

    def __init__(self, folder: Path):
        self.folder, self.host = folder, socket.gethostname().partition(".")[0]
        self.environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf"), "PATH": SEARCH}

    def run(self, *command, **changes) -> str:
        """Output of a command; raises where it fails."""
        done = subprocess.run(
            list(map(str, command)), env={**self.environment, **changes}, capture_output=True, text=True, timeout=600,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, f"{command}: {done.returncode}\n{done.stdout}{done.stderr}"
        return done.stdout.strip()

    def states(self) -> dict[str, tuple[str, str, int]]:
        """State, exit code and number of restarts of all jobs, by array number or, without one, job number."""
        found = {}
        for record in self.run("scontrol", "show", "job", "--oneliner").splitlines():
            values = dict(re.findall(r"(\w+)=(\S*)", record))
            name = f"{values['ArrayJobId']}_{values['ArrayTaskId']}" if "ArrayTaskId" in values else values["JobId"]
            found[name] = values["JobState"], values["ExitCode"], int(values["Restarts"])
        return found

    def wait(self, seconds: float) -> dict[str, tuple[str, str, int]]:
        """States of the jobs as soon as none is waiting or running."""
        until = time.monotonic() + seconds
        while self.run("squeue", "--noheader"):
            assert time.monotonic() < until, self.run("squeue") + "\n" + self.logs()
            time.sleep(0.5)
        return self.states()

    def logs(self) -> str:
        """The last lines of all daemons."""
        texts = [f"{path.name}: {path.read_text(errors='replace')[-1500:]}" for path in self.folder.glob("*.log")]
        return "\n".join(texts)


@contextlib.contextmanager
def cluster(folder: Path):
    """A running Cluster in `folder`, which exists and is empty."""
    folder.chmod(0o755)
    for name in ("munge", "state", "spool"):
        (folder / name).mkdir(mode=0o755)
    key = folder / "munge" / "key"
    key.write_bytes(os.urandom(128))
    key.chmod(0o600)
    found = Cluster(folder)
    ports = _free_ports(2)
    user = subprocess.run(["id", "-un"], capture_output=True, text=True, check=True).stdout.strip()
    values = {"host": found.host, "folder": folder, "user": user}
    text = CONFIGURATION.format(controller_port=ports[0], node_port=ports[1], **values)
    (folder / "slurm.conf").write_text(text)
    if _version(found) >= (23, 11):
        (folder / "cgroup.conf").write_text("CgroupPlugin=disabled\n")
    files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
    munge = [f"--{option}={folder}/munge/{file}" for option, file in files.items()]
    with contextlib.ExitStack() as daemons:
        _start(daemons, found, ["munged", "--foreground", "--force", *munge])
        _until(found, lambda: (folder / "munge" / "socket").exists())
        _start(daemons, found, ["slurmctld", "-D", "-c"])
        _start(daemons, found, ["slurmd", "-D", "-N", found.host])
        _until(found, lambda: "idle" in found.run("sinfo", "--noheader", "--format=%T"))
        try:
            yield found
        finally:
            with contextlib.suppress(Exception):
                found.run("scancel", "--full", "--user", user)
                found.run("scancel", "--signal=KILL", "--full", "--user", user)
                found.wait(20.0)


def _start(daemons, found, command):
    program = shutil.which(command[0], path=SEARCH)
    libc = ctypes.CDLL(None)
    with (found.folder / f"{command[0]}.stderr.log").open("w") as said:
        daemon = subprocess.Popen(
            [program, *command[1:]], env=found.environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=said, start_new_session=True,
            preexec_fn=lambda: libc.prctl(SET_PARENT_DEATH_SIGNAL, signal.SIGKILL),
        )  # fmt: skip
    daemons.callback(_end, daemon)


def _end(daemon) -> None:
    daemon.terminate()
    try:
        daemon.wait(10.0)
    except subprocess.TimeoutExpired:
        daemon.kill()
        daemon.wait()


def _until(found, condition) -> None:
    until = time.monotonic() + START_SECONDS
    while True:
        with contextlib.suppress(AssertionError):
            if condition():
                return
        assert time.monotonic() < until, f"Slurm did not start:\n{found.logs()}"
        time.sleep(0.2)


def _free_ports(count) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    try:
        for item in sockets:
            item.bind(("127.0.0.1", 0))
        return [item.getsockname()[1] for item in sockets]
    finally:
        for item in sockets:
            item.close()


def _version(found) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", found.run("sbatch", "--version"))[:2]))
