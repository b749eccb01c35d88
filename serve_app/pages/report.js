// The data of a report: a file with these pages, in which the documents of one league replace the server.

/** {league, made_at, documents}, null on a page of a server. `documents`: path in the API → its response, lists as a whole. */
export const report = JSON.parse(document.getElementById("report")?.textContent ?? "null");

const PAGING = ["limit", "before", "offset", "from", "to"];

/** The document of a path; undefined if the report does not contain it. */
export function documentOf(path) {
  const { pathname, searchParams } = new URL(path, "file:///");
  const parameters = [...searchParams].filter(([name]) => !PAGING.includes(name)).map((pair) => pair.join("="));
  return report.documents[[decodeURIComponent(pathname), ...parameters].join("?")];
}

/** What only a server can do. A report leaves it out. */
export const Live = ({ children }) => (report ? null : children);
