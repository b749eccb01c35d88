// A game with rules of its own that trains on a server: connect four. Arguments: the URL of the server, the league, and
// the number of episodes. The API key is in LEAGUE_API_KEY.

import { Client, type Report, type SimulatedGame } from "policy-league-client";

const ROWS = 6;
const COLUMNS = 7;
const DIRECTIONS = [
  [0, 1],
  [1, 0],
  [1, 1],
  [1, -1],
] as const;

class ConnectFour implements SimulatedGame<number> {
  /** The player of the disc on each square, -1 for none; row 0 is the top. */
  #board: number[][] = [];
  #player = 0;

  reset(): Report[] {
    this.#board = Array.from({ length: ROWS }, () => Array<number>(COLUMNS).fill(-1));
    this.#player = 0;
    return [this.#report(0)];
  }

  step(actions: Record<string, number>): Report[] {
    const column = actions[`player_${this.#player}`] ?? 0;
    const row = this.#board.map((squares) => squares[column]).lastIndexOf(-1);
    this.#board[row]![column] = this.#player;
    const hasWon = DIRECTIONS.some(([down, right]) => this.#line(row, column, down, right) >= 4);
    const winner = this.#player;
    this.#player = 1 - this.#player;
    if (!hasWon && this.#board[0]!.includes(-1)) return [this.#report(this.#player)];
    return [0, 1].map((player) => ({
      ...this.#report(player),
      reward: hasWon ? (player === winner ? 1 : -1) : 0,
      terminated: true,
    }));
  }

  /** The length of the line through a square. */
  #line(row: number, column: number, down: number, right: number): number {
    const player = this.#board[row]![column];
    let length = 1;
    for (const sign of [1, -1]) {
      for (let i = sign; this.#board[row + i * down]?.[column + i * right] === player; i += sign) length++;
    }
    return length;
  }

  /** What a player sees: the own discs and those of the opponent, and the columns that are not full. */
  #report(player: number): Report {
    const observation = this.#board.map((squares) => squares.map((disc) => [+(disc === player), +(disc === 1 - player)]));
    return {
      agent: `player_${player}`,
      observation: { observation, action_mask: this.#board[0]!.map((disc) => +(disc === -1)) },
    };
  }
}

const [url = "http://127.0.0.1:8000", league = "connect_four_ts", limit] = process.argv.slice(2);
await new Client(url).simulate(league, () => new ConnectFour(), {
  name: "connect-four-ts",
  version: "1",
  episodes: 64,
  ...(limit !== undefined && { limit: Number(limit) }),
});
