from dataclasses import replace
from pathlib import Path

from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from asia.data import data_digest
from asia.data.intake.conversion import take_in
from asia.data.intake.sheet import Wanted

from .clean import CLEAN, signals


def write(path: Path) -> None:
    """Stamped points of inputs, and of outputs that are received 40 ms late."""
    store = get_typestore(Stores.LATEST)
    point = store.types["geometry_msgs/msg/PointStamped"]
    header, xyz = store.types["std_msgs/msg/Header"], store.types["geometry_msgs/msg/Point"]
    stamp = store.types["builtin_interfaces/msg/Time"]
    start = 1_790_000_000 * 10**9
    with Writer(path, version=9) as writer:
        topics = [
            writer.add_connection(name, point.__msgtype__, typestore=store) for name in ("/u", "/y")
        ]
        for t, *values in zip(*signals(), strict=True):
            now = start + round(t * 1e9)
            for topic, value, late in zip(topics, values, (0, 40_000_000), strict=True):
                head = header(stamp=stamp(sec=now // 10**9, nanosec=now % 10**9), frame_id="")
                message = point(header=head, point=xyz(x=value, y=0.0, z=0.0))
                raw = store.serialize_cdr(message, point.__msgtype__)
                writer.write(topic, now + late, raw)


def test_a_bag_by_its_header_timestamps(tmp_path: Path) -> None:
    write(tmp_path / "flight")
    wanted = Wanted(("/u/point/x",), ("/y/point/x",))
    found = take_in([tmp_path / "flight"], wanted, "train")
    assert data_digest(found.records) == CLEAN


def test_a_bag_by_the_times_of_receipt(tmp_path: Path) -> None:
    write(tmp_path / "flight")
    wanted = replace(Wanted(("/u/point/x",), ("/y/point/x",)), time="receipt")
    # The outputs come 40 ms later, while the same inputs are held.
    assert data_digest(take_in([tmp_path / "flight"], wanted, "train").records) == CLEAN
