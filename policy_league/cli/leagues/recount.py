"""`league recount`."""

from policy_league.cli.options import AsJson, LeagueName, open_registry
from policy_league.cli.output import counted, emit, say


def recount(league: LeagueName, as_json: AsJson = False) -> None:
    """Compute the sums behind ratings from the ledger again.

    Those that differ are replaced. They are kept with every match, so this finds a difference only after a change of
    the database by other means.
    """
    from league.results.ledger import Ledger

    ledger = Ledger(open_registry())
    schedules = ledger.schedules(league)
    recounted = ((schedule.id, ledger.recount(schedule)) for schedule in schedules)
    differences = {schedule: of_schedule for schedule, of_schedule in recounted if of_schedule}
    if as_json:
        emit({"league": league, "schedules": len(schedules), "differences": differences})
        return
    for schedule, of_schedule in differences.items():
        for difference in of_schedule:
            say(f"{schedule}: {difference} differed and was replaced.")
    say(f"The sums of {counted(len(schedules), 'schedule')} follow from the recorded games.")
