"""Attacks on the machine: files, processes, the network, memory.

None does harm where it succeeds: each opens, asks or allocates, and touches only its own targets.
"""

from collections.abc import Mapping

from asia.errors import Reason
from tests.redteam.attacks.folds import FOLDS, PLACES, WHISPERS
from tests.redteam.attacks.source import candidate, steps
from tests.redteam.evidence import a_step_succeeded, output_flooded, scores_better
from tests.redteam.types import Barrier, CandidateAttack, Mistake, Success

_ALL = (Barrier.NAMESPACES, Barrier.LANDLOCK, Barrier.SECCOMP)
_FILES = (Barrier.NAMESPACES, Barrier.LANDLOCK)
_FORK = """
def fork():
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)

def program(*words):
    if os.waitpid(os.posix_spawn(words[0], words, {}), 0)[1] != 0:
        raise OSError(errno.EPERM, "refused")
"""
_DAEMON = """
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(60)
    os._exit(0)
time.sleep(0.1)
"""
_NETWORK = """
def connect(family, kind, address):
    with socket.socket(family, kind) as line:
        line.settimeout(2)
        line.connect(address)
        for _ in range(2):  # the second datagram hears that nobody received the first
            line.send(b"x")
            time.sleep(0.05)
"""
_FILL = f"""
def fill(count, size):
    made, ends = [], []
    for place in {PLACES}:
        try:
            for n in range(count):
                made.append(os.path.join(place, f"{{MARK}}-{{n}}"))
                with open(made[-1], "wb") as file:
                    file.write(bytes(size))
            return
        except OSError as error:
            ends.append(error)
        finally:
            for path in made:
                if os.path.exists(path):
                    os.remove(path)
            made.clear()
    raise next((end for end in ends if end.errno != errno.ENOENT), ends[0])
"""
_INSTALL = f"""
def install():
    for place in {PLACES}:
        path = os.path.join(place, "p" + MARK + ".py")
        try:
            with open(path, "w") as file:
                file.write("x = 1")
            sys.path.insert(0, place)
            __import__("p" + MARK)
            return
        except OSError as error:
            last = error
        finally:
            if os.path.exists(path):
                os.remove(path)
    raise last
"""
_DEAF = """
for number in range(1, 65):
    try:
        signal.signal(number, signal.SIG_IGN)
    except (OSError, ValueError):
        pass
"""

# Imitations of a worker killed from outside, as by a machine without memory: the fold would run
# again, and the candidate would not be blamed.
_TGKILL = "TGKILL = 234 if os.uname().machine == 'x86_64' else 131"

EXITS = {
    **{f"exit {code}": candidate(fit=f"os._exit({code})") for code in (137, 0, 1, 139, 143, 255)},
    "exit 137 by a thread": candidate(
        fit="import threading\nthreading.Thread(target=os._exit, args=(137,)).start()\n"
        "time.sleep(9)"
    ),
    "exit 137 with more bits": candidate(
        fit="libc.syscall(231 if os.uname().machine == 'x86_64' else 94, 0x189)"
    ),
    "exit 137 in simulate": candidate(before="os._exit(137)"),
    "kill": candidate(fit="os.kill(os.getpid(), signal.SIGKILL)"),
    "kill a thread": candidate(
        fit="call(libc.syscall(TGKILL, os.getpid(), os.getpid(), 9))", top=_TGKILL
    ),
    "kill the group": candidate(fit="os.kill(0, signal.SIGKILL)"),
}


def _attempts(
    number: int,
    name: str,
    tries: str,
    attempts: Mapping[str, str],
    stops: tuple[Barrier, ...],
    success: Success = a_step_succeeded,
    top: str = "",
) -> CandidateAttack:
    """Make the attack whose fit runs each of these codes by itself, on one fold."""
    return CandidateAttack(number, name, tries, {"": steps(attempts, top)}, success, stops, folds=1)


WALLS = (
    _attempts(
        2,
        "write the evaluator's code",
        "opens the evaluator's source, NumPy, its own package and the import path for writing",
        {
            "evaluator": "open(EVALUATOR, 'r+').close()",
            "numpy": "open(np.__file__, 'r+').close()",
            "asia": "open(sys.modules['asia'].__file__, 'r+').close()",
            "import path": "open(os.path.dirname(np.__path__[0]) + '/' + MARK + '.pth',"
            " 'x').close()",
            "kernel settings": "open('/proc/sys/kernel/core_pattern', 'r+').close()",
        },
        _FILES,
    ),
    _attempts(
        4,
        "look into other processes",
        "reads environment, memory, command line, files and root of the evaluator and of process 1",
        {
            f"{what} of {who}": f"open(f'/proc/{{{who}}}/{what}', 'rb').read(1)"
            for who in ("PARENT", "OTHER", "1")
            for what in ("environ", "maps", "cmdline", "mem")
        }
        | {"root of 1": "os.listdir('/proc/1/root' + PLAYGROUND)"}
        | {"files of PARENT": "os.listdir(f'/proc/{PARENT}/fd')"},
        _FILES,
    ),
    _attempts(
        5,
        "read the test file",
        "reads test file, ledger and neighbouring runs, by their paths and by detours",
        {
            "test file": "print(open(VAULT).read())",
            "ledger": "print(open(LEDGER).read())",
            "by process 1": "print(open('/proc/1/root' + VAULT).read())",
            "by its own root": "print(open('/proc/self/root/..' + VAULT).read())",
            "other runs": "print(os.listdir(PLAYGROUND))",
        },
        _FILES,
        lambda seen: seen.leaked or a_step_succeeded(seen),
    ),
    _attempts(
        6,
        "reach the network",
        "connects to services of this machine by TCP, UDP, a socket file and an abstract socket",
        {
            "tcp": "connect(socket.AF_INET, socket.SOCK_STREAM, ('127.0.0.1', PORT))",
            "udp": "connect(socket.AF_INET, socket.SOCK_DGRAM, ('127.0.0.1', PORT))",
            "socket file": "connect(socket.AF_UNIX, socket.SOCK_STREAM, DAEMON)",
            "abstract": "connect(socket.AF_UNIX, socket.SOCK_STREAM, ABSTRACT)",
        },
        _ALL,
        top=_NETWORK,
    ),
    _attempts(
        12,
        "leave a trap for the evaluator",
        "leaves links, pipes and devices to the ledger under names that an evaluator would open",
        {
            "link": "os.symlink(LEDGER, 'log.txt')",
            "pipe": "os.mkfifo('pending.txt')",
            "device": "os.mknod('model.bin', 0o20600, 0x103)",
            "write": "open(LEDGER, 'a').write('x')",
            "rename": "os.rename(LEDGER, LEDGER + '.old')",
            "attributes": "os.utime(LEDGER)",
        },
        _ALL,
        lambda seen: seen.ledger,
    ),
    _attempts(
        13,
        "start processes",
        "forks, spawns programs and a shell",
        {
            "fork": "fork()",
            "spawn": "program('/bin/true')",
            "shell": "if os.system('true') != 0: raise OSError(errno.EPERM, 'refused')",
        },
        (Barrier.SECCOMP, Barrier.LANDLOCK),
        top=_FORK,
    ),
    _attempts(
        14,
        "fill the disk",
        "writes 128 MB wherever it can",
        {"128 MB": "fill(16, 8 << 20)"},
        _FILES,
        top=_FILL,
    ),
    _attempts(
        15,
        "flood with empty files",
        "makes 3000 empty files wherever it can",
        {"3000 files": "fill(3000, 0)"},
        _FILES,
        top=_FILL,
    ),
    _attempts(
        16,
        "eat the memory",
        "asks for more memory than its budget",
        {"memory": "np.empty((MEMORY_MB + 64) << 20, np.uint8)"},
        (Barrier.RLIMITS,),
    ),
    CandidateAttack(
        17,
        "flood the output",
        "prints 20 MB",
        {"": candidate(fit="for _ in range(20):\n    os.write(1, b'x' * 1_000_000)")},
        output_flooded,
        (Barrier.PARENT,),
        folds=1,
    ),
    _attempts(
        18,
        "signal other processes",
        "stops, slows down and limits a neighbour, and signals the evaluator",
        {
            "kill": "os.kill(OTHER, signal.SIGTERM)",
            "stop": "os.kill(OTHER, signal.SIGSTOP)",
            "evaluator": "os.kill(PARENT, signal.SIGCONT)",
            "slow down": "os.setpriority(os.PRIO_PROCESS, OTHER, 19)",
            "limit": "call(libc.prlimit(OTHER, 7, (ctypes.c_long * 2)(64, 64), None))",
        },
        (Barrier.SECCOMP,),
        lambda seen: bool(seen.hurt) or a_step_succeeded(seen),
    ),
    _attempts(
        19,
        "outlive the run",
        "leaves a daemon of its own session that ignores signals",
        {"daemon": _DAEMON},
        (Barrier.SECCOMP,),
        lambda seen: bool(seen.survivors),
    ),
    CandidateAttack(
        20,
        "never end",
        "sleeps in compiled code with all signals ignored, in fit or only once it simulates",
        {
            "fit": candidate(fit=_DEAF + "ctypes.PyDLL(None).sleep(600)"),
            "simulate": candidate(before="ctypes.PyDLL(None).sleep(600)"),
        },
        lambda seen: seen.overran,
        (Barrier.DEADLINE,),
        limit=0.6,
    ),
    _attempts(
        22,
        "leave the sandbox",
        "traces another process, makes namespaces, keys and rings of requests to the kernel",
        {
            "trace": "call(libc.ptrace(0x4206, OTHER, None, None))",
            "trace process 1": "call(libc.ptrace(0x4206, 1, None, None))",
            "namespace": "call(libc.unshare(0x10000000))",
            "key": "call(libc.syscall(ADD_KEY, b'user', MARK.encode(), b'x', 1, -1))",
            "ring": "call(libc.syscall(425, 8, bytes(120)))",
        },
        (Barrier.SECCOMP,),
        top="ADD_KEY = 248 if os.uname().machine == 'x86_64' else 217",
    ),
    CandidateAttack(
        24,
        "remember another fold",
        "hands fold 1's training outputs to fold 2 by files, shared memory and locks",
        FOLDS,
        scores_better,
        (*_ALL, Barrier.FRESH),
        at_once=("locks",),
    ),
    CandidateAttack(
        41,
        "pass for a kill",
        "ends its worker by a code or a signal that stands for a kill from outside",
        EXITS,
        lambda seen: seen.reason is Reason.MEMORY,
        (Barrier.SECCOMP, Barrier.PARENT),
        mistake=Mistake.BELIEVES_CODES,
    ),
    CandidateAttack(
        42,
        "whisper to another fold",
        "hands training outputs to another fold by the number of threads that run and by the "
        "inodes of pipes, which the machine counts for all its processes",
        WHISPERS,
        scores_better,
        (Barrier.SECCOMP, Barrier.PARENT),
        limit=30.0,
        at_once=tuple(name for name in WHISPERS if "in memory" not in name),
    ),
    _attempts(
        36,
        "install a package",
        "starts an installer, writes a package where it can and imports it",
        {
            "installer": "program(sys.executable, '-c', 'pass')",
            "package": "install()",
            "index": "connect(socket.AF_INET, socket.SOCK_STREAM, ('127.0.0.1', PORT))",
        },
        _ALL,
        top=_FORK + _NETWORK + _INSTALL,
    ),
)
