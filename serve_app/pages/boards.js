// Where the pictures of two games may be clicked: places of a square grid over the picture, and the action of each.

const BOARDS = {
  connect_four: { columns: 7, rows: 1, action: (column) => column },
  tictactoe: { columns: 3, rows: 3, action: (column, row) => 3 * column + row },
};

/** {columns, places: actions in reading order} of an environment, or null: then there are only buttons. */
export function boardOf(environment) {
  const board = Object.entries(BOARDS).find(([name]) => environment.includes(name))?.[1];
  if (!board) return null;
  const places = Array.from({ length: board.rows * board.columns }, (_, at) => board.action(at % board.columns, Math.floor(at / board.columns)));
  return { columns: board.columns, places };
}
