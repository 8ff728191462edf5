"""A filter on system calls, for Linux on x86-64 and aarch64: one process, threads, nothing else.

It denies everything that neither a fit nor a simulation needs and that Landlock leaves open: new
processes and programs, sockets, signals to others, other processes' memory and limits, the
attributes of files, locks and other marks on a file that another worker has open too, kernel
objects that outlive a process, namespaces and mounts. Loaded by the worker before candidate code
runs; a filter cannot be taken off again. Only the standard library is imported here.
"""

import ctypes
import os
import signal
import struct
from errno import EAGAIN, ENOSYS, EPERM

# Name, number on x86-64, number on aarch64 ("-": does not exist there).
_DENIED = """
fork 57 -; vfork 58 -; execve 59 221; execveat 322 281; setsid 112 157; setpgid 109 154
socket 41 198; socketpair 53 199
tkill 200 130; rt_sigqueueinfo 129 138; rt_tgsigqueueinfo 297 240; pidfd_open 434 434
pidfd_getfd 438 438; pidfd_send_signal 424 424; process_mrelease 448 448; ptrace 101 117
process_vm_readv 310 270; process_vm_writev 311 271; process_madvise 440 440; kcmp 312 272
migrate_pages 256 238; move_pages 279 239; perf_event_open 298 241
setpriority 141 140; sched_setscheduler 144 119; sched_setparam 142 118; sched_setattr 314 274
sched_setaffinity 203 122; ioprio_set 251 30; setrlimit 160 164
chmod 90 -; fchmod 91 52; fchmodat 268 53; chown 92 -; fchown 93 55; lchown 94 -; fchownat 260 54
utime 132 -; utimes 235 -; futimesat 261 -; utimensat 280 88; setxattr 188 5; lsetxattr 189 6
fsetxattr 190 7; removexattr 197 14; lremovexattr 198 15; fremovexattr 199 16; truncate 76 45
mknod 133 -; mknodat 259 33; sync 162 81; syncfs 306 267; flock 73 32; mincore 27 232
fadvise64 221 223; readahead 187 213; preadv2 327 286; pwritev2 328 287; futex_waitv 449 449
io_setup 206 0
inotify_init 253 -; inotify_init1 294 26; fanotify_init 300 262; name_to_handle_at 303 264
open_by_handle_at 304 265; quotactl 179 60; quotactl_fd 443 443
shmget 29 194; shmat 30 196; shmctl 31 195; semget 64 190; semctl 66 191; semop 65 193
semtimedop 220 192; msgget 68 186; msgctl 71 187; msgsnd 69 189; msgrcv 70 188; mq_open 240 180
mq_unlink 241 181; memfd_create 319 279; memfd_secret 447 447
add_key 248 217; request_key 249 218; keyctl 250 219; bpf 321 280; userfaultfd 323 282
io_uring_setup 425 425; io_uring_enter 426 426; io_uring_register 427 427
unshare 272 97; setns 308 268; mount 165 40; umount2 166 39; pivot_root 155 41; chroot 161 51
mount_setattr 442 442; open_tree 428 428; move_mount 429 429; fsopen 430 430; fspick 433 433
swapon 167 224; swapoff 168 225; acct 163 89; syslog 103 116; vhangup 153 58; reboot 169 142
setuid 105 146; setgid 106 144; setreuid 113 145; setregid 114 143; setresuid 117 147
setresgid 119 149; setgroups 116 159; setfsuid 122 151; setfsgid 123 152; capset 126 91
capget 125 90; personality 135 92; sethostname 170 161; setdomainname 171 162; settimeofday 164 170
clock_settime 227 112; clock_adjtime 305 266; adjtimex 159 171; kexec_load 246 104
kexec_file_load 320 294; init_module 175 105; finit_module 313 273; delete_module 176 106
iopl 172 -; ioperm 173 -; modify_ldt 154 -; timer_create 222 107
sysinfo 99 179; statfs 137 43; fstatfs 138 44; ustat 136 -; sysfs 139 -
pipe 22 -; pipe2 293 59; eventfd 284 -; eventfd2 290 19; epoll_create 213 -; epoll_create1 291 20
timerfd_create 283 85; signalfd 282 -; signalfd4 289 74; membarrier 324 283
getpgid 121 155; getsid 124 156; getpriority 140 141; sched_getscheduler 145 120
sched_getparam 143 121; sched_getattr 315 275; sched_rr_get_interval 148 127; ioprio_get 252 31
get_robust_list 274 100
"""
_CHECKED = """
clone 56 220; clone3 435 435; kill 62 129; tgkill 234 131; prlimit64 302 261; fcntl 72 25
ioctl 16 29; prctl 157 167; futex 202 98; seccomp 317 277; exit 60 93; exit_group 231 94
madvise 28 233; mmap 9 222; clock_gettime 228 113; clock_getres 229 114
clock_nanosleep 230 115
"""
_LAST_KNOWN = 450  # set_mempolicy_home_node; to the worker, later ones do not exist
_ARCHITECTURES = {"x86_64": (0xC000003E, 1), "aarch64": (0xC00000B7, 2)}
_X32 = 0x40000000

_LOAD, _JUMP_EQUAL, _JUMP_ABOVE, _JUMP_SET, _RETURN = 0x20, 0x15, 0x25, 0x45, 0x06
_AND = 0x54
_ALLOW, _ERROR, _TRAP, _KILL = 0x7FFF0000, 0x00050000, 0x00030000, 0x80000000
_CLONE_THREAD, _CLONE_NEW = 0x00010000, 0x7E020000
# Duplicates of a descriptor, its flags, the size of a pipe.
_FCNTL = (0, 1, 2, 3, 4, 1030, 1032)
# TCGETS and TCGETS2 (is it a terminal?), TIOCGWINSZ, FIONREAD, FIONBIO, FIONCLEX, FIOCLEX.
_IOCTL = (0x5401, 0x802C542A, 0x5413, 0x541B, 0x5421, 0x5450, 0x5451)
_KILLED = 128 + signal.SIGKILL
_MADV_MERGEABLE, _MADV_COLD, _MADV_PAGEOUT = 12, 20, 21
_MAP_TYPE, _MAP_PRIVATE, _MAP_HUGETLB = 0x0F, 0x02, 0x40000
_FUTEX_PRIVATE, _FUTEX_CLOCK = 0x80, 0x100
_FUTEX_WAIT, _FUTEX_WAKE, _FUTEX_WAIT_BITSET = 0, 1, 9
_PR_SET_PDEATHSIG, _PR_SET_NO_NEW_PRIVS, _PR_GET_SECCOMP, _PR_SET_TIMERSLACK = 1, 38, 21, 29
_SLACK_NANOSECONDS = 500_000
_SET_MODE_FILTER, _ALL_THREADS = 1, 1


def why_not() -> str | None:
    """None if this kernel takes filters and the architecture has a table here, else the reason."""
    machine = os.uname().machine
    if machine not in _ARCHITECTURES:
        return f"no table of system calls for {machine}"
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_GET_SECCOMP, 0, 0, 0, 0) < 0:
        return "this kernel was built without seccomp"
    return None


def install() -> None:
    """Bind all threads of this process. Raises OSError if the kernel refuses."""
    machine = os.uname().machine
    program = build(machine, os.getpid())
    code = ctypes.create_string_buffer(program, len(program))
    head = struct.pack("@HP", len(program) // 8, ctypes.addressof(code))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "no_new_privs was refused")
    # As a handler, `usleep` takes the signal's number, 31, for microseconds; the slack of timers
    # makes them half a millisecond, or waiting would keep a core busy.
    libc.prctl(_PR_SET_TIMERSLACK, _SLACK_NANOSECONDS, 0, 0, 0)
    libc.signal(signal.SIGSYS, ctypes.cast(libc.usleep, ctypes.c_void_p))
    words = (numbers(machine)["seccomp"], _SET_MODE_FILTER, _ALL_THREADS)
    if libc.syscall(*(ctypes.c_long(word) for word in words), head) != 0:
        raise OSError(ctypes.get_errno(), "the filter was refused")


def numbers(machine: str) -> dict[str, int]:
    """Number of each system call that the filter names."""
    column = _ARCHITECTURES[machine][1]
    rows = _rows(_DENIED) + _rows(_CHECKED)
    return {row[0]: int(row[column]) for row in rows if row[column] != "-"}


def build(machine: str, pid: int) -> bytes:
    """The filter as BPF instructions of 8 bytes, for the process `pid`."""
    known = numbers(machine)
    checked = [row[0] for row in _rows(_CHECKED)]
    number_fits = _step(_LOAD, 0)
    if machine == "x86_64":
        number_fits += _step(_JUMP_ABOVE, _X32 - 1, 0, 1) + _step(_RETURN, _KILL)
    code = _step(_LOAD, 4) + _step(_JUMP_EQUAL, _ARCHITECTURES[machine][0], 1, 0)
    code += _step(_RETURN, _KILL) + number_fits
    code += _step(_JUMP_ABOVE, _LAST_KNOWN, 0, 1) + _step(_RETURN, _ERROR | ENOSYS)
    # glibc falls back from clone3, whose flags lie in memory where no filter sees them, to clone.
    code += _when(known["clone3"], _step(_RETURN, _ERROR | ENOSYS))
    thread = _step(_LOAD, _low(0)) + _step(_JUMP_SET, _CLONE_THREAD, 0, 1)
    thread += _step(_JUMP_SET, _CLONE_NEW, 0, 1) + _deny() + _allow()
    code += _when(known["clone"], thread)
    # No worker ends itself by SIGKILL, nor by the code that stands for it: that is a word from
    # outside.
    for name, argument in (("kill", 1), ("tgkill", 2)):
        own = _step(_LOAD, _low(0)) + _step(_JUMP_EQUAL, pid, 1, 0) + _deny()
        code += _when(known[name], own + _unless(argument, signal.SIGKILL))
    ends = _step(_LOAD, _low(0)) + _step(_AND, 0xFF) + _step(_JUMP_EQUAL, _KILLED, 0, 1)
    ends += _step(_RETURN, _KILL) + _allow()
    code += _when(known["exit"], ends) + _when(known["exit_group"], ends)
    # Reading one's own limits. A root could raise them again, a user those of other processes.
    reads = _step(_LOAD, _low(2)) + _step(_JUMP_EQUAL, 0, 1, 0) + _deny()
    reads += _step(_LOAD, _low(2) + 4) + _step(_JUMP_EQUAL, 0, 1, 0) + _deny()
    reads += _step(_LOAD, _low(0)) + _step(_JUMP_EQUAL, 0, 1, 0)
    reads += _step(_JUMP_EQUAL, pid, 0, 1) + _allow() + _deny()
    code += _when(known["prlimit64"], reads)
    code += _when(known["fcntl"], _only(1, _FCNTL))
    code += _when(known["ioctl"], _only(1, _IOCTL))
    code += _when(known["prctl"], _unless(0, _PR_SET_PDEATHSIG))
    code += _when(known["futex"], _futex())
    # Throwing a file out of memory, so that another worker sees it come from the disk, and sharing
    # equal pages with other processes, which a write to one of them shows by its time.
    advices = (_MADV_MERGEABLE, _MADV_COLD, _MADV_PAGEOUT)
    code += _when(known["madvise"], _unless(2, *advices))
    # Shared memory, of which each piece takes a number from one counter of the kernel. Pages of the
    # huge kind are files to the kernel, private ones too.
    private = _step(_LOAD, _low(3)) + _step(_JUMP_SET, _MAP_HUGETLB, 2, 0)
    private += _step(_AND, _MAP_TYPE) + _step(_JUMP_EQUAL, _MAP_PRIVATE, 1, 0) + _deny() + _allow()
    code += _when(known["mmap"], private)
    # Negative numbers are clocks of processes and devices.
    for name in ("clock_gettime", "clock_getres", "clock_nanosleep"):
        own = _step(_LOAD, _low(0)) + _step(_JUMP_SET, 1 << 31, 0, 1) + _deny() + _allow()
        code += _when(known[name], own)
    for name, number in known.items():
        if name not in checked:
            code += _when(number, _deny())
    return code + _allow()


def _rows(table: str) -> list[list[str]]:
    return [row.split() for row in table.replace("\n", ";").split(";") if row.strip()]


def _step(code: int, value: int, if_true: int = 0, if_false: int = 0) -> bytes:
    return struct.pack("@HBBI", code, if_true, if_false, value)


def _low(argument: int) -> int:
    """Return the offset of the lower half of an argument; both architectures are little-endian."""
    return 16 + 8 * argument


def _deny() -> bytes:
    return _step(_RETURN, _ERROR | EPERM)


def _allow() -> bytes:
    return _step(_RETURN, _ALLOW)


def _when(number: int, body: bytes) -> bytes:
    """`body`, which returns, for this system call. The accumulator holds the number before."""
    return _step(_JUMP_EQUAL, number, 0, len(body) // 8) + body


def _unless(argument: int, *values: int) -> bytes:
    """Allow but for these values of the argument."""
    code = _step(_LOAD, _low(argument))
    for value in values:
        code += _step(_JUMP_EQUAL, value, 0, 1) + _deny()
    return code + _allow()


def _only(argument: int, values: tuple[int, ...]) -> bytes:
    code = _step(_LOAD, _low(argument))
    for value in values:
        code += _step(_JUMP_EQUAL, value, 0, 1) + _allow()
    return code + _deny()


def _futex() -> bytes:
    """A futex that is not private to the process lies, on a page of a shared file, between workers.

    Futures of libstdc++, which XLA uses, and joining a thread wait on such ones in their own
    memory. So no wait on them sleeps in the kernel, where others could wake or count it. They check
    again after any result of a wait: WAIT, which a future uses, gives a positive number after the
    short sleep that `install` attaches to SIGSYS; the rest EAGAIN at once, a time limit or not.
    """
    code = _step(_LOAD, _low(1)) + _step(_JUMP_SET, _FUTEX_PRIVATE, 0, 1) + _allow()
    for operation, answer in (
        (_FUTEX_WAKE, _ALLOW),
        (_FUTEX_WAIT, _TRAP),
        (_FUTEX_WAIT_BITSET, _ERROR | EAGAIN),
        (_FUTEX_WAIT_BITSET | _FUTEX_CLOCK, _ERROR | EAGAIN),
    ):
        code += _step(_JUMP_EQUAL, operation, 0, 1) + _step(_RETURN, answer)
    return code + _deny()
