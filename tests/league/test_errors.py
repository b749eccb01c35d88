from league.errors import NotFound, from_document, last_line, one_line, to_document


def test_an_error_keeps_its_type_as_data() -> None:
    document = to_document(NotFound("no such league"))
    assert document == {"code": "not_found", "message": "no such league"}
    error = from_document(document)
    assert type(error) is NotFound
    assert str(error) == "no such league"


def test_an_error_is_one_line() -> None:
    error = ValueError("two\n  lines")
    assert (one_line(error), one_line(error, with_type=True)) == ("two lines", "ValueError: two lines")
    assert one_line(TimeoutError()) == one_line(TimeoutError(), with_type=True) == "TimeoutError"
    assert one_line(ValueError("the  first\nthe second"), with_type=True, first_line=True) == "ValueError: the first"
    assert [last_line(text) for text in ("first\n second \n\n", "\n", "")] == ["second", "", ""]
