// What can be measured after a pass, side by side; buttons that answer while the scan asks; what was chosen so far.

const MEANINGS = { next: "the next pass of the plan", again: "the last angles again", offset: "offset projections", retake: "bad projections again", enough: "no further pass" };
const CHOSEN_BY = { program: "program", operator: "operator", plan: "nobody: as planned" };

export class Passes {
  /** answer: takes a choice, where the person may act and the scan asks. */
  constructor(box, { answer }) {
    Object.assign(this, { box, answer, ended: null, asks: false, mayAct: false, decisions: [] });
  }

  /** A pass is over. */
  end(data) { this.ended = data; this.asks = (data.wait ?? 0) > 0; this.draw(); }

  /** A state that ends the question without a choice. */
  finish() { this.asks = false; this.draw(); }

  /** What was chosen. The event also says what an earlier decision has brought, by the number of its pass. */
  choose(data) {
    const judged = this.decisions.find((decision) => decision.number === data.judged) ?? this.decisions[this.decisions.length - 1];
    if (judged) for (const name of ["predicted", "gained", "gained_low", "gained_high"]) judged[name] = data[name] ?? judged[name];
    const chosen = data.options.find((option) => option.choice === data.choice);
    this.decisions.push({ ...data, predicted: chosen?.gain ?? null, gained: null, gained_low: null, gained_high: null });
    this.asks = false;
    this.draw();
  }

  /** Whether the scan runs, and whether this person may act. */
  update(runs, mayAct) {
    if (runs === this.runs && mayAct === this.mayAct) return;
    Object.assign(this, { runs, mayAct });
    this.draw();
  }

  draw() {
    const find = (name) => this.box.querySelector(name), asks = this.asks && this.runs, { ended } = this;
    this.box.hidden = !ended && !this.decisions.length;
    find("thead + tbody").replaceChildren(...(ended ? ended.options : []).map((option) => this.rowOf(option, asks && this.mayAct)));
    find("small").textContent = ended ? `pass ${ended.passes ?? ended.number} has ended, ${ended.n_views} projections so far` : "";
    const how = this.mayAct ? "Choose above" : "beamline decide CHOICE";
    const question = asks ? `The scan waits for your decision on what to measure next. ${how}; after ${ended.wait.toFixed(0)} s without an answer it continues its plan.` : "";
    find(".asks").textContent = [ended?.remark, question].filter(Boolean).join(" ");
    find(".decisions").hidden = !this.decisions.length;
    find(".decisions tbody").replaceChildren(...this.decisions.map((decision) => row([decision.passes ?? decision.number, decision.choice, CHOSEN_BY[decision.by] ?? decision.by, db(decision.predicted), db(decision.gained) + rangeOf(decision.gained_low, decision.gained_high), decision.reason])).reverse());
  }

  /** A row of the table, with a button where this person may answer. */
  rowOf(option, mayAnswer) {
    const { choice, gain, low, high, seconds } = option, recommended = choice === this.ended.recommended;
    const rate = gain === null || !seconds ? "-" : db(60 * gain / seconds);
    const line = row([MEANINGS[choice] ? `${choice}: ${MEANINGS[choice]}` : choice, gain === null ? "not known" : db(gain) + rangeOf(low, high), rate, `${seconds.toFixed(0)} s`, `${(100 * option.dose).toFixed(1)} %`, size(option.bytes), recommended ? "recommended" : ""]);
    if (recommended) line.className = "recommended";
    if (mayAnswer) {
      const button = document.createElement("button");
      button.textContent = choice;
      button.addEventListener("click", () => this.answer(choice));
      line.insertCell().append(button);
    }
    return line;
  }
}

function row(texts) {
  const line = document.createElement("tr");
  for (const text of texts) line.insertCell().textContent = text;
  return line;
}
function db(value) { return value === null || value === undefined ? "–" : `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(2)}`; }
function rangeOf(low, high) { return (low ?? null) === null || (high ?? null) === null || low === high ? "" : ` (${low.toFixed(2)} to ${high.toFixed(2)})`; }
function size(bytes) { return bytes < 1e9 ? `${(bytes / 1e6).toFixed(0)} MB` : `${(bytes / 1e9).toFixed(2)} GB`; }
