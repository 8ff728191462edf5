"""Commands of the package, and its options of other commands."""

from asia.control.commands.certify import certify
from asia.control.commands.control import control
from asia.control.commands.monitor import monitor
from asia.control.commands.next_experiment import next_
from asia.interfaces.cli.options import Command

CONTROL = Command(control, after="linear")
MONITOR = Command(monitor, after="control")
CERTIFY = Command(certify, after="monitor")
NEXT = Command(next_, after="certify")
