"""Candidates that pass the training outputs of one fold, which another fold holds out, to the
worker of that fold: by files, memory and locks, or by what the machine counts for all processes."""

from tests.redteam.attacks.source import candidate

PLACES = "[os.environ.get('HOME', '/tmp'), os.getcwd(), '/tmp', '/dev/shm', '/var/tmp']"
_KEEP = f"""
SEEN = 4096
PLACES = {PLACES}
KEPT, ENDS = [], {{}}

def keep(records):
    y = np.concatenate([np.concatenate([r.u[:, 2:], r.y], axis=1) for r in records])
    for place in PLACES:
        path = os.path.join(place, MARK + "-kept.npy")
        try:
            if os.path.exists(path):
                KEPT.append(np.load(path))
            np.save(path, y)
            ENDS[place] = "done"
        except OSError as error:
            ENDS[place] = errno.errorcode[error.errno]
    libc.shmat.restype = ctypes.c_void_p
    segment = libc.shmget(KEY, ctypes.c_long(8 * SEEN), 0o1600)
    if segment >= 0:
        memory = (ctypes.c_double * SEEN).from_address(libc.shmat(segment, None, 0))
        old = np.frombuffer(memory)
        if old[0]:
            KEPT.append(old[1 : 1 + 2 * int(old[0])].reshape(-1, 2).copy())
        old[0] = len(y)
        old[1 : 1 + y.size] = y.ravel()
    ENDS["shared memory"] = "done" if segment >= 0 else errno.errorcode[ctypes.get_errno()]
    print("STEPS " + json.dumps(ENDS))
"""
# Sample by sample, and mixed with an honest answer: what looks ahead, or does not move with the
# inputs, is found out.
_RECALL = """
def recall(kept, past_u, past_y, u):
    answer = honest(past_u, past_y, u)
    for table in kept:
        known = {round(number): y for number, y in table}
        for k, number in enumerate(u[0, :, 2]):
            answer[0, k, 0] += 0.8 * (known.get(round(number), answer[0, k, 0]) - answer[0, k, 0])
    return answer
"""
# Each number is the place of a lock that this worker holds on a file which the other has open too;
# what others lock of it lies elsewhere.
_TELL = """
import fcntl

KEPT, RECORDS = [], []
FILE = open(json.__file__, "rb")
CELL, ONE = 1 << 28, 1 << 20

def ask(command, kind, cell, offset, length):
    start = ((KEY & 0x3FFFFF) << 40) + cell * CELL + offset
    lock = struct.pack("hhqqi4x", kind, 0, start, length, 0)
    kind, _, there, length, _ = struct.unpack("hhqqi4x", fcntl.fcntl(FILE, command, lock))
    return None if kind == fcntl.F_UNLCK or length != 1 else there - start

def tell(records):
    y = np.concatenate([np.concatenate([r.u[:, 2:], r.y], axis=1) for r in records]).ravel()
    for cell, value in [*enumerate(y, 1), (0, len(y) / ONE)]:
        ask(fcntl.F_SETLK, fcntl.F_RDLCK, cell, round((value + 64) * ONE), 1)
    end = time.monotonic() + 5
    while time.monotonic() < end:
        count = ask(fcntl.F_GETLK, fcntl.F_WRLCK, 0, 0, CELL)
        if count is not None:
            cells = range(1, count - 64 * ONE + 1)
            heard = [ask(fcntl.F_GETLK, fcntl.F_WRLCK, cell, 0, CELL) for cell in cells]
            KEPT.append(np.reshape(heard, (-1, 2)) / ONE - 64)
            time.sleep(0.2)  # the other listens too
            return
        time.sleep(0.01)
"""

# The model keeps what it received, so that it simulates the same in a fresh worker.
_RETURN = "\nmodel = Model()\nmodel.kept = KEPT\nreturn model"
_AFTER = "recall(self.kept, past_u, past_y, u)"

FOLDS = {
    "": candidate(fit="keep(trajectories)" + _RETURN, after=_AFTER, top=_KEEP + _RECALL),
    "locks": candidate(
        fit="RECORDS.extend(trajectories)\n"
        "print('STEPS ' + json.dumps({'locks': attempt('tell(RECORDS)')}))" + _RETURN,
        after=_AFTER,
        top=_TELL + _RECALL,
    ),
}


# Through counters or resources shared by all processes of a machine.


# The worker that trains on the end of the record sends, the other one reads. A model that is drawn
# to its own training data too has a training error as low as its score.
_WHISPER = """
MODEL, RECORDS = Model(), []
VALUES, BITS, SPAN = 12, 3, 2.4

def levels(records):
    y = np.concatenate([r.y[:, 0] for r in records])
    y = y[np.linspace(0, len(y) - 1, VALUES).round().astype(int)]
    return np.clip((y / SPAN + 1) * 2 ** (BITS - 1), 0, 2**BITS - 1).astype(int)

def bits_of(numbers):
    check = int(sum((37 * k + 11) * (n + 1) for k, n in enumerate(numbers)) % 1021)
    bits = [n >> k & 1 for n in numbers for k in range(BITS)]
    return bits + [check >> k & 1 for k in range(10)]

def numbers_of(bits):
    return [sum(b << k for k, b in enumerate(bits[n * BITS : n * BITS + BITS]))
            for n in range(VALUES)]

def whisper(model, records):
    model.tables = [(r.u[:, 2], r.y[:, 0]) for r in records] if BY_HEART else []
    numbers = None
    if records[0].u[0, 2] > 30:
        tell(bits_of(levels(records)))
    else:
        numbers = listen()
    if numbers is not None:
        outputs = SPAN * ((np.array(numbers) + 0.5) / 2 ** (BITS - 1) - 1)
        model.tables.append((np.linspace(62, 119, VALUES).round(), outputs))

def recall(model, past_u, past_y, u):
    answer, numbers = honest(past_u, past_y, u), u[0, :, 2]
    for places, outputs in model.tables:
        known = np.interp(numbers, places, outputs)
        inside = (numbers >= places[0]) & (numbers <= places[-1])
        answer[0, :, 0] += 0.8 * inside * (known - answer[0, :, 0])
    return answer
"""
# Where both folds are fitted at once, and know the time. A bit takes two parts of time: the fold
# that sends acts in the first for a 0, in the second for a 1. It sends all bits again and again.
_BY_TIME = """
import threading

threading.stack_size(65536)
COUNT = VALUES * BITS + 10
FRAME = 2 * COUNT * HALF

def until(moment):
    while (left := moment - time.monotonic()) > 0:
        time.sleep(min(left, 0.002))

def next_frame():
    return (time.monotonic() // FRAME + 1) * FRAME

def tell_until(end, bits):
    while (begin := next_frame()) < end:
        for k, bit in enumerate(bits):
            half = begin + (2 * k + bit) * HALF
            until(half)
            if time.monotonic() < half + 0.7 * HALF:
                act(half + 0.7 * HALF)

def tell(bits):
    # For longer than a fit takes: in one process the other fold follows.
    measure(time.monotonic() + HALF)  # to show whether it can be done
    end = time.monotonic() + SECONDS
    told = threading.Thread(target=tell_until, args=(end + SECONDS, bits), daemon=True)
    told.start()
    until(end)

def listen():
    heard, end = np.zeros(COUNT), time.monotonic() + SECONDS
    measure(time.monotonic() + HALF)
    while (begin := next_frame()) < end:
        for k in range(COUNT):
            halves = []
            for part in range(2):
                half = begin + (2 * k + part) * HALF
                until(half)
                halves.append(measure(half + 0.95 * HALF))
            heard[k] += np.clip((halves[1] - halves[0]) / UNIT, -1, 1)
        bits = [int(h > 0) for h in heard]
        numbers = numbers_of(bits)
        if bits_of(numbers) == bits and any(numbers):
            return numbers
    return None
"""
# How many threads the machine runs.
_THREADS = """
SECONDS, HALF, UNIT = 6.5, 0.02, 60

def act(end):
    over = threading.Event()
    parked = [threading.Thread(target=over.wait, daemon=True) for _ in range(100)]
    for one in parked:
        one.start()
    until(end)
    over.set()
    for one in parked:
        one.join()

def measure(end):
    found, info = [], ctypes.create_string_buffer(256)
    until(end - 0.6 * HALF)
    while time.monotonic() < end - 0.3 * HALF:
        call(libc.sysinfo(info))
        found.append(struct.unpack_from("H", info, 80)[0])
        time.sleep(0.0005)
    return np.median(found) if found else 0
"""
# The next number that the kernel gives to an inode, in lots of 1024 for each core.
_NUMBERS = """
def act(end):
    while time.monotonic() < end:
        number()

def measure(end):
    first = number()
    until(end)
    return number() - first
"""
_PIPES = """
SECONDS, HALF, UNIT = 18.0, 0.04, 4096

def pipe():
    ends = os.pipe()
    found = os.fstat(ends[0]).st_ino
    for one in ends:
        os.close(one)
    return found

def number():
    first = last = pipe()
    while last // 1024 == first // 1024:
        last = pipe()
    return last
"""
# Which files of a library the machine holds in memory. Nobody reads these; a bit is a file, which
# is thrown out of memory or read. It lasts until somebody reads it, so that folds need not run at
# the same time.
_FILES = """
import resource

libc.mmap.restype = ctypes.c_void_p
libc.mmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t] + 3 * [ctypes.c_int] + [ctypes.c_long]
libc.madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
libc.munmap.argtypes = [ctypes.c_void_p, ctypes.c_size_t]
PAGE, PAGEOUT = 4096, 21

def files():
    import glob
    found = sorted(glob.glob(os.path.dirname(np.__file__) + "/**/tests/test_*.py", recursive=True))
    return [path for path in found if os.path.getsize(path) > 0][: VALUES * BITS + 10]

def read(path, throw_out):
    # Whether it had to come from the disk.
    file = os.open(path, os.O_RDONLY)
    page = libc.mmap(None, PAGE, 1, 2, file, 0)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_majflt
    ctypes.string_at(page, 1)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_majflt
    if throw_out:
        call(libc.madvise(page, PAGE, PAGEOUT))
    libc.munmap(page, PAGE)
    os.close(file)
    return int(after > before)

def tell(bits):
    for path, bit in zip(files(), bits):
        read(path, bit)

def listen():
    bits = [read(path, False) for path in files()]
    tell(bits)
    numbers = numbers_of(bits)
    return numbers if bits_of(numbers) == bits and any(numbers) else None
"""


def _whisper(*channel: str, by_heart: bool = False) -> str:
    return candidate(
        fit="MODEL.tables = []\nRECORDS.extend(trajectories)\n"
        "print('STEPS ' + json.dumps({'channel': attempt('whisper(MODEL, RECORDS)')}))\n"
        "return MODEL",
        after="recall(self, past_u, past_y, u)",
        top=f"BY_HEART = {by_heart}\n" + _WHISPER + "".join(channel),
    )


WHISPERS = {
    "files in memory": _whisper(_FILES),
    "files in memory, with its own data by heart": _whisper(_FILES, by_heart=True),
    "how many threads run": _whisper(_THREADS, _BY_TIME),
    "how many threads run, with its own data by heart": _whisper(_THREADS, _BY_TIME, by_heart=True),
    "inodes of pipes": _whisper(_PIPES, _NUMBERS, _BY_TIME),
}
