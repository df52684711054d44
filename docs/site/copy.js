/* A button on each code block copies its text. */
document.addEventListener("DOMContentLoaded", () => {
  for (const block of document.querySelectorAll(".rst-content pre")) {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "copy-code";
    button.textContent = "Copy";
    button.addEventListener("click", async () => {
      const text = (block.querySelector("code") || block).textContent.replace(/\n$/, "");
      button.textContent = (await copied(text)) ? "Copied" : "Press Ctrl-C";
      setTimeout(() => { button.textContent = "Copy"; }, 2000);
      if (button.textContent !== "Copied") getSelection().selectAllChildren(block.querySelector("code") || block);
    });
    const frame = document.createElement("div");
    frame.className = "code-block";
    block.replaceWith(frame);
    frame.append(block, button);
  }
});

/* Whether the text is in the clipboard; pages from a file or without https have only the older way. */
async function copied(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const area = document.createElement("textarea");
    area.value = text;
    area.style.position = "fixed";
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    return done;
  }
}
