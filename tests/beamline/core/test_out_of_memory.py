"""Running out of memory is not reported as a defect of the program."""

import errno

import pytest

from beamline.core.errors import DataError, exit_code, is_defect, out_of_memory, user_message


@pytest.mark.parametrize("error", [MemoryError(), OSError(errno.ENOMEM, "Cannot allocate memory")])
def test_memory_that_ran_out_is_no_defect(error: BaseException) -> None:
    assert out_of_memory(error) and not is_defect(error) and exit_code(error) == DataError.exit_code
    assert user_message(error).startswith("Out of memory (")
