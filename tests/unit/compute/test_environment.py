import os
import subprocess
import sys
from pathlib import Path

import pytest

import pchem_pipeline
from pchem_pipeline.compute import environment
from pchem_pipeline.compute.environment import available_memory, available_workers, prepare_environment

CODE = (
    "import os; from pchem_pipeline.compute.environment import prepare_environment as p\n"
    "p(); first = os.environ['NUMBA_CACHE_DIR']; p(); assert first == os.environ['NUMBA_CACHE_DIR']\n"
    "print(first)"
)


def cache_folder(**environment):
    place = str(Path(pchem_pipeline.__file__).parents[1])
    environment = {"PYTHONPATH": place, "PATH": "/usr/bin:/bin", **environment}
    command = [sys.executable, "-c", CODE]
    result = subprocess.run(command, cwd="/", env=environment, capture_output=True, text=True, check=True)
    return Path(result.stdout.strip())


def test_the_cache_lies_in_the_users_cache_folder(tmp_path):
    home = cache_folder(HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert home.is_relative_to(tmp_path / "cache")


@pytest.mark.parametrize("trap", ["none", "written by all", "a link", "another user's"])
def test_a_folder_in_the_temporary_one_is_taken_if_nobody_else_can_write_it(tmp_path, trap):
    expected = tmp_path / f"pchem_pipeline-{os.getuid()}"
    (tmp_path / "else").mkdir(mode=0o700)
    if trap == "a link":
        expected.symlink_to("else")
    elif trap != "none":
        expected.mkdir()
        expected.chmod(0o777 if trap == "written by all" else 0o700)
    if trap == "another user's":
        if os.getuid() != 0:
            pytest.skip("nobody else may give folders away")
        os.chown(expected, 4321, -1)
    nowhere = {"HOME": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/nowhere", "TMPDIR": str(tmp_path)}
    first, second = (cache_folder(**nowhere) for _ in range(2))
    assert first.parent == tmp_path
    if trap == "none":
        assert first == second == expected
        assert expected.stat().st_mode & 0o777 == 0o700
    else:
        assert expected not in (first, second)
        assert first != second
        assert not first.exists()  # it ended with its process


def test_figures_need_no_home_and_print_nothing(tmp_path):
    code = CODE + "; import matplotlib.pyplot"
    place = str(Path(pchem_pipeline.__file__).parents[1])
    for home in ("/proc/nowhere", str(tmp_path)):
        known = {"PYTHONPATH": place, "PATH": "/usr/bin:/bin", "HOME": home, "TMPDIR": str(tmp_path)}
        found = subprocess.run(
            [sys.executable, "-c", code], cwd="/", env=known, capture_output=True, text=True
        )
        assert (found.returncode, found.stderr) == (0, "")
    assert (tmp_path / ".config/matplotlib").is_dir()  # where there is a home, the user's own settings count


def test_the_users_own_values_are_kept(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    monkeypatch.delenv("MPLBACKEND", raising=False)
    prepare_environment()
    assert os.environ["OMP_NUM_THREADS"] == "5"
    assert os.environ["MPLBACKEND"] == "Agg"


def write(folder, **files):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(f"{text}\n")


@pytest.fixture
def job(tmp_path, monkeypatch):
    """A root of cgroups, and a function that puts this process into one."""
    monkeypatch.setattr(environment, "_CGROUPS", tmp_path)
    for name in ("SLURM_CPUS_PER_TASK", "SLURM_CPUS_ON_NODE", "SLURM_MEM_PER_NODE", "SLURM_MEM_PER_CPU"):
        monkeypatch.delenv(name, raising=False)
    read = Path.read_text
    files = {"/proc/meminfo": "MemFree: 1 kB\nMemAvailable: 32000000 kB\n", "/proc/self/cgroup": "0::/\n"}
    monkeypatch.setattr(Path, "read_text", lambda self, *args: files.get(str(self)) or read(self, *args))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    return tmp_path, lambda text: files.update({"/proc/self/cgroup": text})


def test_limits_of_a_job_are_seen_at_every_level_of_its_cgroup(job):
    root, enter = job
    assert (available_workers(), available_memory()) == (16, 32000000 << 10)  # without limits the machine
    enter("0::/slurm/job_7/step_0\n")
    write(root / "slurm/job_7/step_0", memory__max="max", memory__current=5 << 20, cpu__max="max 100000")
    write(root / "slurm/job_7", memory__max=700 << 20, memory__current=300 << 20, cpu__max="350000 100000")
    write(root / "slurm/job_7", memory__stat=f"anon 9\ninactive_file {200 << 20}")
    write(root / "slurm/job_8", memory__max=1 << 20, memory__current=0, cpu__max="100000 100000")
    assert (available_workers(), available_memory()) == (3, 600 << 20)
    # a limit from which a job is slowed down counts
    enter("damaged\n0::/job\n")
    write(root / "job", memory__max="max", memory__high=700 << 20, memory__current=100 << 20, cpu__max="1 0")
    assert (available_workers(), available_memory()) == (16, 600 << 20)


def test_limits_of_version_1(job):
    root, enter = job
    enter("4:memory:/slurm/job_7\n3:cpu,cpuacct:/slurm/job_7\n0::/\n")
    write(root / "memory/slurm/job_7", memory__limit_in_bytes=700 << 20, memory__usage_in_bytes=100 << 20)
    write(root / "memory", memory__limit_in_bytes=9223372036854771712, memory__usage_in_bytes=1 << 30)
    write(root / "cpu/slurm/job_7", cpu__cfs_quota_us=-1, cpu__cfs_period_us=100000)
    write(root / "cpu/slurm", cpu__cfs_quota_us=200000, cpu__cfs_period_us=100000)
    assert (available_workers(), available_memory()) == (2, 600 << 20)
    enter("3:cpuacct,cpu:/job_8\n")  # the controllers in another order, and no link of one of them
    write(root / "cpuacct,cpu/job_8", cpu__cfs_quota_us=400000, cpu__cfs_period_us=100000)
    assert available_workers() == 4
    enter("4:memory:/of/the/host\n")  # in a container, which sees its own as the root
    write(root / "memory", memory__limit_in_bytes=500 << 20, memory__usage_in_bytes=100 << 20)
    assert available_memory() == 400 << 20


def test_what_slurm_gave_is_a_limit_without_cgroups_too(job, monkeypatch):
    monkeypatch.setenv("SLURM_CPUS_ON_NODE", "6")
    monkeypatch.setenv("SLURM_MEM_PER_CPU", "200")
    assert (available_workers(), available_memory()) == (6, 1200 << 20)
    monkeypatch.setenv("SLURM_CPUS_PER_TASK", "2")
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "700")
    assert (available_workers(), available_memory()) == (2, 700 << 20)
    monkeypatch.setenv("SLURM_MEM_PER_NODE", "0")  # all memory of the node
    monkeypatch.delenv("SLURM_MEM_PER_CPU")
    assert available_memory() == 32000000 << 10
