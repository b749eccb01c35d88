/** References to policies, versions and mixtures. */

import { InvalidInput } from "./errors.js";

/** A policy of a league at a version: a number, an alias, or undefined for the current champion. */
export class Model {
  constructor(
    readonly policy: string,
    readonly version: number | string | undefined,
  ) {}

  /** Parses `LEAGUE[.POLICY][@VERSION]`. Throws InvalidInput. */
  static parse(text: string): Model {
    const match = /^([a-z0-9_-]+(?:\.[a-z0-9_-]+)?)(?:@([a-z0-9_-]+))?$/.exec(text);
    if (!match?.[1]) throw invalid(`model "${text}" must be LEAGUE, LEAGUE@VERSION or LEAGUE.POLICY@VERSION`);
    return new Model(match[1], match[2] === undefined ? undefined : parseVersion(match[2]));
  }

  /** Path of the policy's routes. */
  get path(): string {
    return `/v1/policies/${this.policy}`;
  }

  /** Query string that specifies the version. */
  get query(): string {
    return this.version === undefined ? "" : `?version=${this.version}`;
  }

  /** Returns the same policy at a version. */
  at(version: number): Model {
    return new Model(this.policy, version);
  }

  toString(): string {
    return this.version === undefined ? this.policy : `${this.policy}@${this.version}`;
  }
}

/** The league and the members of `connect_four@3`, or of a mixture, `connect_four@3:0.6,@5:0.4`. Throws InvalidInput. */
export function parseMembers(text: string): { league: string; members: { version: number; probability: number }[] } {
  const members = text.split(",").map((part) => {
    const match = /^([a-z0-9_-]*)@(\d+)(?::([0-9.eE+-]+))?$/.exec(part.trim());
    if (!match) throw invalid(`"${part.trim()}" must be LEAGUE@NUMBER, or in a mixture LEAGUE@NUMBER:PROBABILITY`);
    return { league: match[1] ?? "", version: Number(match[2]), probability: Number(match[3] ?? 1) };
  });
  const league = checkName("league", members[0]?.league ?? "");
  const other = members.find((member) => member.league && member.league !== league);
  if (other) throw invalid(`${other.league}@${other.version} is not a version of league ${league}`);
  return { league, members: members.map(({ version, probability }) => ({ version, probability })) };
}

/** Returns a valid name of a league or an alias. Throws InvalidInput. */
export function checkName(kind: string, text: string): string {
  if (!/^[a-z0-9_-]{1,100}$/.test(text)) throw invalid(`${kind} "${text}" must consist of a-z, 0-9, "_" and "-"`);
  return text;
}

function parseVersion(text: string): number | string {
  return /^\d+$/.test(text) ? Number(text) : text;
}

function invalid(message: string): InvalidInput {
  return new InvalidInput(message, { code: "invalid_reference" });
}

/** Returns the path of a league. */
export function leaguePath(league: string): string {
  return `/v1/leagues/${checkName("league", league)}`;
}
