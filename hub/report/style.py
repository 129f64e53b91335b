"""The report's style sheet: system fonts, a light page, figures that read in black and white, and print."""

STYLE = """
:root{--ink:#1b2430;--soft:#55606e;--line:#d9dee5;--blue:#123a5f;--orange:#c2510a;--good:#1d6b3a;--bad:#a3200d;--note:#5b4a00}
*{box-sizing:border-box}
body{margin:0;background:#f4f6f8;color:var(--ink);font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"Noto Sans",
"Liberation Sans",Arial,sans-serif;-webkit-font-smoothing:antialiased}
main,header.top{max-width:1080px;margin:0 auto;padding:0 20px}
header.top{display:flex;justify-content:space-between;align-items:baseline;padding-top:26px;color:var(--soft);font-size:13px}
header.top b{color:var(--ink);font-size:15px;letter-spacing:.02em}
section{background:#fff;border:1px solid var(--line);border-radius:10px;padding:22px 26px;margin:16px 0}
h1{font-size:26px;line-height:1.2;margin:0 0 6px;letter-spacing:-.01em}
h2{font-size:18px;margin:0 0 4px;letter-spacing:-.005em}
h3{font-size:13px;margin:20px 0 6px;color:var(--soft);font-weight:600;text-transform:uppercase;letter-spacing:.06em}
p{margin:0 0 12px;max-width:78ch;break-inside:avoid}
p.lead{color:var(--soft)}
small{font-size:12px;color:var(--soft);font-weight:400}
.quiet{color:var(--soft)}
code{font:13px/1.4 ui-monospace,SFMono-Regular,Menlo,Consolas,"Liberation Mono",monospace;
background:#eef1f5;padding:1px 5px;border-radius:4px;overflow-wrap:anywhere}
.assessment{border-left:8px solid var(--good);padding-left:22px}
.assessment.attention{border-left-color:var(--orange);border-left-style:double}
.assessment.refused{border-left-color:var(--bad);border-left-style:double}
.keys{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:12px;margin:18px 0 20px}
.keys div{border:1px solid var(--line);border-radius:8px;padding:10px 14px}
.keys b{display:block;font-size:22px;line-height:1.25;font-variant-numeric:tabular-nums;white-space:nowrap}
.keys span{font-size:12.5px;color:var(--soft);line-height:1.35;display:block}
.columns{display:grid;grid-template-columns:1fr 1fr;gap:6px 34px}
.columns h3{margin-top:4px}
ul.findings{list-style:none;margin:0 0 10px;padding:0}
ul.findings li{position:relative;padding:0 0 8px 30px;overflow-wrap:anywhere}
ul.findings li::before{position:absolute;left:0;top:2px;width:19px;height:19px;border-radius:50%;
text-align:center;font:700 12px/19px system-ui,sans-serif;color:#fff}
li.good::before{content:"✓";background:var(--good)}
li.attention::before{content:"!";background:var(--bad);border-radius:4px!important}
li.note::before{content:"i";background:#fff;color:var(--note)!important;box-shadow:inset 0 0 0 1.5px var(--note)}
ol.todo{margin:0 0 8px;padding-left:22px}
ol.todo li{padding:0 0 8px 4px;overflow-wrap:anywhere}
.wide{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-size:14px;font-variant-numeric:tabular-nums;margin:6px 0}
th{text-align:left;font-weight:600;border-bottom:2px solid var(--ink);padding:6px 14px 6px 0;vertical-align:bottom}
th small{display:block}
td{border-bottom:1px solid var(--line);padding:7px 14px 7px 0;vertical-align:top}
td.n,th.n{text-align:right;padding:7px 0 7px 14px}
table.cameras td.n{white-space:nowrap}
.pm{color:var(--soft);margin-left:4px}
table.pairs td:first-child{white-space:nowrap}
table.pairs td{padding-top:5px;padding-bottom:5px}
svg{display:block;width:100%;height:auto;overflow:visible}
svg text{font-family:inherit;font-size:13px;fill:var(--ink);font-variant-numeric:tabular-nums}
svg text.tick{fill:var(--soft);font-size:12px}
svg text.rowname,svg text.strong{font-weight:600}
svg text.halo{paint-order:stroke;stroke:#fff;stroke-width:5px;stroke-linejoin:round}
.paper{fill:#fff}
.grid{stroke:#e3e7ec;stroke-width:1}
.zero{stroke:#9aa4b0;stroke-width:1}
.whisker{stroke:var(--blue);stroke-width:2}
.estimate{fill:var(--blue)}
.diamond{fill:#fff;stroke:var(--blue);stroke-width:2}
.edge{stroke-width:2.6;fill:none}
.edge.agrees{stroke:var(--blue)}
.edge.contradicts{stroke:var(--orange);stroke-dasharray:12 4 2 4}
.edge.refused{stroke:#7d8794;stroke-width:1.8;stroke-dasharray:2 6;stroke-linecap:round}
.node{fill:var(--blue);stroke:#fff;stroke-width:2}
.node.refused{fill:#fff;stroke:#55606e;stroke-width:1.6;stroke-dasharray:4 3}
svg text.nodename{fill:#fff;font-weight:600;font-size:14px}
svg text.nodename.refused{fill:var(--soft)}
.legend{display:flex;flex-wrap:wrap;gap:6px 22px;color:var(--soft);font-size:13px;max-width:none;align-items:center}
.legend span{display:inline-flex;align-items:center;gap:8px}
svg.sample{width:46px;flex:none}svg.sample.small{width:16px}
.ring{fill:#fff;stroke:#7d8794;stroke-width:1.4}.clash{stroke:var(--orange);stroke-width:3}
.swatch{width:18px;height:12px;border:1px solid #9aa4b0;display:inline-block}
.swatch.few{background:#eef2f6}.swatch.many{background:#b3c4d6}.swatch.none{background:#fff}
.maps svg,.views svg{overflow:hidden}
.maps{display:grid;grid-template-columns:repeat(auto-fill,minmax(300px,1fr));gap:18px 22px;margin-top:10px}
.maps.two{grid-template-columns:1fr 1fr}
figure{margin:0;break-inside:avoid}
figcaption{font-size:13px;color:var(--soft);padding-top:5px}
figcaption b{color:var(--ink);margin-right:6px}
.image{fill:#fff;stroke:#8a95a3;stroke-width:1}
.cell.c1{fill:#eef2f6}.cell.c2{fill:#dfe7ef}.cell.c3{fill:#cfdbe7}.cell.c4{fill:#c1cfde}.cell.c5{fill:#b3c4d6}
.arrow{stroke:#101820;stroke-width:1.5}
.head,.dot{fill:#101820}
.cross{stroke:#8a95a3;stroke-width:1}
.seen{fill:var(--blue);fill-opacity:.55}
.band{fill:#bccfe2}.bandline{stroke:#bccfe2;stroke-width:2}
.median{fill:none;stroke:var(--blue);stroke-width:1.5;stroke-linejoin:round}
.bar{fill:#8fa9c4}.bar.both{fill:var(--blue)}.bar.path{fill:var(--orange)}
.track{fill:none;stroke:var(--orange);stroke-width:1.3;stroke-linejoin:round}
.frustum{fill:#123a5f22;stroke:var(--blue);stroke-width:1}
.frustumline{stroke:var(--blue);stroke-width:1.2}
.start{fill:#fff;stroke:var(--orange);stroke-width:2}
.end{fill:var(--orange);stroke:#fff;stroke-width:1}
.scalebar{stroke:var(--ink);stroke-width:3}
.graph{display:grid;grid-template-columns:minmax(0,5fr) minmax(0,6fr);gap:26px;align-items:center}
.views{display:grid;grid-template-columns:1fr 1fr;gap:18px;align-items:start;margin-top:12px}
.frame{border:1px solid var(--line);border-radius:6px;padding:1px}
ul.why{margin:10px 0 0;padding-left:18px;font-size:13px;color:var(--soft)}
#scene-3d{height:540px}
dl.facts{display:grid;grid-template-columns:max-content 1fr;gap:5px 22px;margin:8px 0 0;font-size:14px}
dl.facts dt{color:var(--soft)}dl.facts dd{margin:0;overflow-wrap:anywhere}
dl.words dt{font-weight:600;margin-top:8px}dl.words dd{margin:0 0 2px;max-width:82ch}
summary{cursor:pointer;font-weight:600}
@media screen and (max-width:760px){.columns,.graph,.views,.maps.two{grid-template-columns:1fr}
section{padding:18px 16px}}
@media print{
@page{margin:14mm}
body{background:#fff;font-size:11.5px}
section{border:0;border-top:1px solid #999;border-radius:0;padding:12px 0;margin:0}
section.assessment{border-left-width:8px;padding-left:14px;border-top:0}
header.top,main{max-width:none;padding:0}
h1{font-size:20px}h2{font-size:15px}
h2,h3,p.lead,p.legend{break-after:avoid}
table{font-size:10.5px}small{font-size:9px}
td,th{padding:3px 8px 3px 0}td.n,th.n{padding:3px 0 3px 8px}
.wide{overflow:visible}
.keys{grid-template-columns:repeat(5,1fr);gap:6px}.keys b{font-size:16px}.keys span{font-size:10px}
tr,svg,.keys div,li,.graph,.views{break-inside:avoid}
.screen{display:none!important}
.maps{grid-template-columns:1fr 1fr}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}
}
"""
