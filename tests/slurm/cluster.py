"""Bring up a real Slurm on this machine: MariaDB, slurmdbd, slurmctld and two slurmds in a folder of their own.

    apt-get install --no-install-recommends slurm-wlm slurmdbd mariadb-server

Nothing of the machine's own configuration is read or written, and every daemon that was started is stopped at the end.
Accounting (slurmdbd with MariaDB) is what real clusters have: without it, nobody can say why a job ended.
"""

import contextlib
import ctypes
import getpass
import os
import secrets
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

PROGRAMS = ("mariadbd", "mariadb-install-db", "slurmdbd", "slurmctld", "slurmd", "sbatch", "sacctmgr")
NODES = ("n1", "n2")
PR_SET_PDEATHSIG = 1  # linux/prctl.h
PATH = f"{os.environ['PATH']}:/usr/sbin:/sbin"

SLURM_CONF = """
ClusterName=check
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ctld_port}
SlurmUser=root
StateSaveLocation={folder}/ctld
SlurmctldPidFile={folder}/slurmctld.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdSpoolDir={folder}/spool_%n
SlurmdPidFile={folder}/slurmd_%n.pid
SlurmdLogFile={folder}/slurmd_%n.log
SlurmdTimeout=20
AuthType=auth/none
CredType=cred/none
ReturnToService=2
MpiDefault=none
TaskPlugin=task/none
ProctrackType=proctrack/linuxproc
KillWait=5
# Memory is watched by polling, so that no cgroups are needed; a job that takes more than it asked for is killed.
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
AccountingStorageType=accounting_storage/slurmdbd
AccountingStorageHost=127.0.0.1
AccountingStoragePort={dbd_port}
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SchedulerParameters=sched_interval=2,bf_interval=2,batch_sched_delay=0
SlurmdParameters=config_overrides
NodeName=n1 NodeHostname={host} NodeAddr=127.0.0.1 Port={n1_port} CPUs=1 RealMemory=4000
NodeName=n2 NodeHostname={host} NodeAddr=127.0.0.1 Port={n2_port} CPUs=1 RealMemory=4000
PartitionName=main Nodes=n1,n2 Default=YES MaxTime=INFINITE State=UP
"""

SLURMDBD_CONF = """
AuthType=auth/none
DbdHost=localhost
DbdAddr=127.0.0.1
DbdPort={dbd_port}
SlurmUser=root
PidFile={folder}/slurmdbd.pid
LogFile={folder}/slurmdbd.log
StorageType=accounting_storage/mysql
StorageHost=127.0.0.1
StoragePort={sql_port}
StorageUser=slurm
StoragePass={password}
"""


def missing() -> str | None:
    """Why no Slurm can be brought up here, or None."""
    absent = [name for name in PROGRAMS if shutil.which(name, path=PATH) is None]
    if absent:
        return f"needs {', '.join(absent)}: apt-get install --no-install-recommends slurm-wlm slurmdbd mariadb-server"
    if os.geteuid() != 0:
        return f"slurmd runs as root, this is {getpass.getuser()}"
    return None


class Cluster:
    """A Slurm of two nodes with a CPU each, up between `__enter__` and `__exit__`; `environment` is its users'."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.environment = {**os.environ, "PATH": PATH, "SLURM_CONF": str(folder / "slurm.conf")}
        self.daemons: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> "Cluster":
        try:
            self._configure()
            self._database()
            self.start("slurmdbd", "slurmdbd", "-D")
            self._until("slurmdbd answers", lambda: self.ok("sacctmgr", "-n", "list", "cluster"))
            self.ok("sacctmgr", "-i", "add", "cluster", "check")
            self.start("slurmctld", "slurmctld", "-D", "-f", str(self.folder / "slurm.conf"))
            for node in NODES:
                self.start_node(node)
            self._until("both nodes are idle", lambda: self.states() == {"n1": "idle", "n2": "idle"})
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        self.stop()

    def start(self, name: str, *command: str) -> None:
        """Start a daemon in the foreground of a process group of its own; its output goes to NAME.out."""
        with (self.folder / f"{name}.out").open("ab") as out:
            self.daemons[name] = subprocess.Popen(
                command,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                start_new_session=True,
                preexec_fn=end_with_parent,
            )

    def start_node(self, node: str) -> None:
        self.start(node, "slurmd", "-D", "-N", node, "-f", str(self.folder / "slurm.conf"))

    def kill_node(self, node: str) -> None:
        """Kill the slurmd of a node and everything that it started, as a power cut does."""
        slurmd = self.daemons.pop(node)
        pids = [slurmd.pid, *self._of_node(node)]
        for number in (signal.SIGSTOP, signal.SIGKILL):  # all stand still first: one that lives would report the others
            for pid in pids:
                send(pid, number)
        slurmd.wait()

    def _of_node(self, node: str) -> set[int]:
        """The processes of a node's jobs and the slurmstepds above them, which do not have the node in their names."""
        processes = set()
        for path in Path("/proc").glob("[0-9]*/environ"):
            with contextlib.suppress(OSError):
                if f"SLURMD_NODENAME={node}".encode() in path.read_bytes().split(b"\0"):
                    processes.add(int(path.parent.name))
                    parent = path.with_name("stat").read_text().rpartition(")")[2].split()[1]
                    if Path(f"/proc/{parent}/cmdline").read_bytes().startswith(b"slurmstepd"):
                        processes.add(int(parent))
        return processes

    def stop(self) -> None:
        """Stop every daemon, the ones that were started last first."""
        self.ok("scancel", "--user", getpass.getuser())
        for pid in [pid for node in NODES for pid in self._of_node(node)]:
            send(pid, signal.SIGKILL)
        for name, daemon in reversed(self.daemons.items()):
            daemon.send_signal(signal.SIGTERM)
            try:
                daemon.wait(timeout=15)
            except subprocess.TimeoutExpired:
                print(f"{name} did not stop, killed")
                daemon.kill()
                daemon.wait()
        self.daemons.clear()

    def run(self, *command: str) -> str:
        """The output of a command of a user of this Slurm."""
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True, check=True, timeout=60)
        return done.stdout.strip()

    def ok(self, *command: str) -> bool:
        """Whether a command succeeds."""
        return subprocess.run(command, env=self.environment, capture_output=True, check=False).returncode == 0

    def states(self) -> dict[str, str]:
        """The state of each node, as sinfo has it."""
        return dict(line.split() for line in self.run("sinfo", "-h", "-N", "-o", "%N %t").splitlines())

    def _configure(self) -> None:
        (self.folder / "ctld").mkdir(parents=True)
        names = ("ctld_port", "dbd_port", "sql_port", "n1_port", "n2_port")
        values = {
            "folder": str(self.folder),
            "host": socket.gethostname(),
            "password": secrets.token_hex(8),
            **dict(zip(names, free_ports(len(names)), strict=True)),
        }
        self.sql = values
        for name, text in (("slurm.conf", SLURM_CONF), ("slurmdbd.conf", SLURMDBD_CONF)):
            path = self.folder / name
            path.write_text(text.format(**values))
            path.chmod(0o600)

    def _database(self) -> None:
        data, sock = self.folder / "sql", self.folder / "sql.socket"
        words = ("--no-defaults", "--user=root", f"--datadir={data}")
        self.run("mariadb-install-db", *words, "--auth-root-authentication-method=socket")
        self.start(
            "mariadbd",
            "mariadbd",
            *words,
            f"--socket={sock}",
            "--bind-address=127.0.0.1",
            f"--port={self.sql['sql_port']}",
            f"--pid-file={self.folder}/sql.pid",
            "--innodb-buffer-pool-size=64M",
            "--innodb-lock-wait-timeout=900",
        )
        grant = f"GRANT ALL ON *.* TO slurm@localhost IDENTIFIED BY '{self.sql['password']}'"
        self._until("MariaDB answers", lambda: self.ok("mariadb", "--no-defaults", f"--socket={sock}", "-e", grant))

    def _until(self, what: str, holds: Callable[[], bool], seconds: float = 60) -> None:
        """Wait until something holds; raises RuntimeError that names it and the daemons' logs."""
        wait_until(f"{what} (logs: {self.folder})", holds, seconds, self._dead)

    def _dead(self) -> str | None:
        dead = [name for name, daemon in self.daemons.items() if daemon.poll() is not None]
        return f"{', '.join(dead)} ended, see {self.folder}/{dead[0]}.out" if dead else None


def end_with_parent() -> None:
    """Have this process told to stop (SIGTERM) when the one that started it ends, even by SIGKILL."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def wait_until(
    what: str, holds: Callable[[], bool], seconds: float, hopeless: Callable[[], str | None] = lambda: None
) -> None:
    """Wait until `holds()`; raises RuntimeError after `seconds`, or as soon as `hopeless()` gives a reason."""
    end = time.monotonic() + seconds
    while not holds():
        reason = hopeless()
        if reason or time.monotonic() > end:
            raise RuntimeError(f"waited for: {what}: {reason or f'not within {seconds:.0f} s'}")
        time.sleep(0.5)


def free_ports(count: int) -> list[int]:
    """Ports on which nobody listens."""
    sockets = [socket.socket() for _ in range(count)]
    for socket_ in sockets:
        socket_.bind(("127.0.0.1", 0))
    ports = [socket_.getsockname()[1] for socket_ in sockets]
    for socket_ in sockets:
        socket_.close()
    return ports


def send(pid: int, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, number)
