(() => {
  const form = document.getElementById("filter");
  if (!form) return;
  const { text, task, verdict } = form.elements;
  const rows = [...document.querySelectorAll("#episodes tbody tr")].map((row) => {
    const words = row.textContent.toLowerCase();
    return { row, words, tokens: new Set(words.split(/\s+/)), verdicts: row.dataset.v.split(" ") };
  });
  const apply = () => {
    const wanted = text.value.trim().toLowerCase();
    let shown = 0;
    for (const { row, words, tokens, verdicts } of rows) {
      const fits =
        words.includes(wanted) &&
        (!task.value || tokens.has(task.value)) &&
        (!verdict.value || verdicts.includes(verdict.value));
      row.hidden = !fits;
      shown += fits;
    }
    form.querySelector("output").textContent = `${shown} of ${rows.length} shown`;
  };
  form.addEventListener("input", apply);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.hidden = false;
  apply();
})();
