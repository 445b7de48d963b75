/**
 * What the page does when it is opened.
 */

if (facts.rows !== null) add_rows(facts.rows);
if (facts.details !== null) add_details(facts.details);
document.querySelectorAll("table").forEach(labelCells);
showTableHead();
showRows();
drawMap();
document.getElementById("map-colour")?.addEventListener("change", colourMap);
byId("find").addEventListener("input", showRows);
byId("only").addEventListener("change", showRows);
window.matchMedia("print").addEventListener("change", (event) => showForPrint(event.matches));
window.addEventListener("hashchange", openByHash);
listenToStage();
openByHashOrWorst(facts.row_files.length === 0);
if (facts.row_files.length) loadRows();
