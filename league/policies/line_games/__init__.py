"""Scripts for games that are won by a line of pieces: connect four and tic-tac-toe."""
