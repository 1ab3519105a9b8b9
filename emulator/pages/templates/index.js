const table = document.querySelector("table"), body = table.tBodies[0], rows = [...body.rows];
const heads = table.querySelectorAll("thead th");
const text = document.querySelector("#text"), verdict = document.querySelector("#verdict");
document.querySelector(".tools").hidden = false;
const fits = row => row.textContent.toLowerCase().includes(text.value.toLowerCase())
  && (!verdict.value || row.dataset.verdict === verdict.value);
const show = () => rows.forEach(row => row.hidden = !fits(row));
text.oninput = verdict.onchange = show;
heads.forEach((head, place) => {
  const button = document.createElement("button");
  button.append(...head.childNodes); head.append(button);
  button.onclick = () => {
    const sign = head.ariaSort === "ascending" ? -1 : 1;
    heads.forEach(other => other.removeAttribute("aria-sort"));
    head.ariaSort = sign > 0 ? "ascending" : "descending";
    const key = row => row.cells[place].dataset.sort ?? "", isNumber = head.className.includes("number");
    const order = (a, b) => isNumber ? a - b : a.localeCompare(b, "en", {numeric: true});
    rows.sort((a, b) => (key(a) === "") - (key(b) === "") || sign * order(key(a), key(b)));
    body.append(...rows);
  };
});
