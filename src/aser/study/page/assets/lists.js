// The ledger sorts and filters, and the list of figures is searched.
"use strict";

(() => {
  const at = (id) => document.getElementById(id);
  const words = (text) => text.toLowerCase().split(/\s+/).filter(Boolean);

  // Figures: all words of the search stand in the figure's text.
  const figures = [...document.querySelectorAll("article.figure")];
  const texts = new Map(figures.map((one) => [one, one.textContent.toLowerCase()]));
  const findFigures = () => {
    const wanted = words(at("figure-search").value);
    for (const one of figures) one.hidden = !wanted.every((word) => texts.get(one).includes(word));
    const shown = figures.filter((one) => !one.hidden).length;
    at("figure-count").textContent = `${shown} of ${figures.length} figures`;
  };
  at("figure-search").addEventListener("input", findFigures);
  // A link to a figure that the search hides shows it again.
  addEventListener("hashchange", () => {
    const target = document.getElementById(location.hash.slice(1));
    if (target && target.hidden) {
      at("figure-search").value = "";
      findFigures();
      target.scrollIntoView();
    }
  });

  // The ledger.
  const body = at("ledger").tBodies[0];
  const rows = [...body.rows];
  const heads = [...at("ledger").tHead.rows[0].cells];
  const filters = ["claim-search", "claim-part", "claim-verdict", "claim-figure", "claim-single"];
  const findClaims = () => {
    const wanted = words(at("claim-search").value);
    const [part, verdict, figure] = ["part", "verdict", "figure"].map((n) => at(`claim-${n}`).value);
    const single = at("claim-single").checked;
    let shown = 0;
    for (const row of rows) {
      const { dataset } = row;
      const text = row.textContent.toLowerCase();
      const fits =
        (single || !("single" in dataset)) &&
        (!part || dataset.part === part) &&
        (!verdict || dataset.verdict === verdict) &&
        (!figure || dataset.figure === figure) &&
        wanted.every((word) => text.includes(word));
      row.hidden = !fits;
      shown += fits;
    }
    at("claim-count").textContent = `${shown} of ${rows.length} rows`;
  };
  for (const id of filters) at(id).addEventListener("input", findClaims);

  const value = (row, column) => {
    const cell = row.cells[column];
    if ("value" in cell.dataset) return cell.dataset.value === "" ? null : Number(cell.dataset.value);
    return cell.textContent.trim() || null;
  };
  const compare = (one, other) => {
    if (one === null || other === null) return (one === null) - (other === null);
    if (typeof one === "number" && typeof other === "number") return one - other;
    return String(one).localeCompare(String(other), "en", { numeric: true });
  };
  // Rows without a value stay at the end in both directions.
  const sort = (column, direction) => {
    const sorted = column < 0 ? rows : [...rows].sort((a, b) => {
      const [one, other] = [value(a, column), value(b, column)];
      const order = compare(one, other);
      return one === null || other === null ? order : direction * order;
    });
    body.append(...sorted);
    heads.forEach((head, i) => {
      const way = direction > 0 ? "ascending" : "descending";
      head.setAttribute("aria-sort", i === column ? way : "none");
    });
    at("claim-sort").value = column < 0 ? "" : `${column} ${direction}`;
  };
  at("claim-sort").add(new Option("the ledger's order", ""));
  heads.forEach((head, i) => {
    const name = head.textContent.trim();
    at("claim-sort").add(new Option(`${name}, up`, `${i} 1`));
    at("claim-sort").add(new Option(`${name}, down`, `${i} -1`));
    head.querySelector("button").addEventListener("click", () => {
      sort(i, head.getAttribute("aria-sort") === "ascending" ? -1 : 1);
    });
  });
  at("claim-sort").addEventListener("input", () => {
    const [column, direction] = at("claim-sort").value.split(" ").map(Number);
    if (at("claim-sort").value === "") sort(-1, 1);
    else sort(column, direction);
  });

  findFigures();
  findClaims();
})();
