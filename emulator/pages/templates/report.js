const said = document.querySelector("#said"), lines = [...document.querySelector("#log tbody").rows];
document.querySelector("#log .tools").hidden = false;
const fits = line => said.value.toLowerCase().split(/\s+/).every(word => line.textContent.toLowerCase().includes(word));
said.oninput = () => lines.forEach(line => line.hidden = !fits(line));
