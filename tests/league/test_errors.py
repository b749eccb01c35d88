import pytest

from league.errors import NotFound, from_document, last_line, one_line, to_document


@pytest.mark.parametrize(
    ("error", "message", "with_type"),
    [
        (ValueError("two\n  lines"), "two lines", "ValueError: two lines"),
        (TimeoutError(), "TimeoutError", "TimeoutError"),
    ],
)
def test_an_error_is_one_line(error: Exception, message: str, with_type: str) -> None:
    assert one_line(error) == message
    assert one_line(error, with_type=True) == with_type


def test_further_lines_can_be_left_out() -> None:
    assert one_line(ValueError("the  first\nthe second"), with_type=True, first_line=True) == "ValueError: the first"


@pytest.mark.parametrize(("text", "last"), [("first\n second \n\n", "second"), ("\n", ""), ("", "")])
def test_the_last_line_is_not_blank(text: str, last: str) -> None:
    assert last_line(text) == last


def test_an_error_keeps_its_type_as_data() -> None:
    document = to_document(NotFound("no such league"))
    assert document == {"code": "not_found", "message": "no such league"}
    error = from_document(document)
    assert type(error) is NotFound
    assert str(error) == "no such league"
