"""A short run of experiment service-faults disks: each kind of fault once."""

from __future__ import annotations

import pytest
from tests.service.log_faults import KINDS, campaign
from tests.waiting import MOST_S


# Python 3.12 warns of any fork beside threads: the children use none of theirs.
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_no_fault_of_a_disk_file_or_process_loses_or_doubles_an_acknowledged_state(capsys):
    assert campaign(len(KINDS), seed=52, within_s=MOST_S)
    said = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in said] == [*KINDS, "all"]
    assert all(": 1 faults, " in line and ", 0 acknowledged" not in line for line in said[:-1])
