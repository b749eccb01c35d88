// Boards whose pictures can be clicked: a grid of cells over the picture, and the action of each cell.

const BOARDS = {
  connect_four: { columns: 7, rows: 1, action: (column) => column },
  tictactoe: { columns: 3, rows: 3, action: (column, row) => 3 * column + row },
};

/** {columns, cells: actions in reading order} of an environment; null if its picture cannot be clicked. */
export function boardOf(environment) {
  const board = Object.entries(BOARDS).find(([name]) => environment.includes(name))?.[1];
  if (!board) return null;
  const cells = Array.from({ length: board.rows * board.columns }, (_, index) => board.action(index % board.columns, Math.floor(index / board.columns)));
  return { columns: board.columns, cells };
}
