// The runs of a folder as a table, newest first; the name of a folder leads to the page of its run.
const $ = (name) => document.querySelector(name);
const PERIOD = 3000;  // ms
let said = "";
if (location.hash.startsWith("#act=")) { sessionStorage.setItem("act", location.hash.slice(5)); history.replaceState(null, "", location.pathname); }

function row(cells, kind, link = null) {
  const made = document.createElement("tr");
  cells.forEach((text, i) => {
    const cell = document.createElement(kind), last = i === cells.length - 1;
    if (link && last) {
      const to = document.createElement("a");
      to.href = link; to.textContent = text; cell.append(to);
    } else cell.textContent = text;
    made.append(cell);
  });
  return made;
}

async function show() {
  try {
    const answer = await fetch("/api/runs"), text = await answer.text();
    if (!answer.ok) throw new Error(text);
    if (text === said) return;
    said = text;
    const { folder, head, rows, newest } = JSON.parse(text);
    if (newest !== null) location.replace(`run/${newest}/`);  // of the program that records: to the page of its run
    document.title = `Runs in ${folder}`;
    $("#folder").textContent = `${rows.length} ${rows.length === 1 ? "run" : "runs"} in ${folder}`;
    $("thead").replaceChildren(row(head, "th"));
    $("tbody").replaceChildren(...rows.flatMap(({ number, cells, next }) => {
      const advice = row(next ? [next] : [], "td");
      if (next) advice.firstChild.colSpan = head.length;
      return [row(cells, "td", `/run/${number}/`), ...(next ? [advice] : [])];
    }));
    $("#said").textContent = "";
  } catch (error) { $("#said").textContent = error.message; said = ""; }
}

await show();
setInterval(() => { if (!document.hidden) show(); }, PERIOD);
