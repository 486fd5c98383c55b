from mapper.core.errors import DataError


def test_the_middle_of_a_long_message_is_left_out():
    assert str(DataError("log.txt:3: 'x' is no number")) == "log.txt:3: 'x' is no number"
    said = str(DataError(f"log.txt:3: {5000 * '1'} is no number"))
    assert said.startswith("log.txt:3: 111")
    assert " … " in said
    assert said.endswith("111 is no number")
    assert len(said) < 1000
