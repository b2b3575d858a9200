"""The page of 1,000 recordings: written, and opened and sorted in headless Chromium where there is one."""

import shutil
import subprocess
import time
from dataclasses import replace
from pathlib import Path


def page_of_many(out: Path, work: Path) -> None:
    """The page of 1,000 recordings: written, and opened and sorted in headless Chromium where there is one."""
    from rmis_calib.batches.job_record import JobRecord
    from rmis_calib.batches.page import write_index
    from rmis_calib.batches.summary import BatchSummary

    folder = work / "many"
    records = [record for record in map(JobRecord.read, sorted((out / "good").iterdir())) if record is not None]
    many = []
    for i in range(1000):
        name = f"case_{i:04d}"
        (folder / name).mkdir(parents=True)
        shutil.copy(out / records[i % len(records)].name / "thumbnail.jpg", folder / name)
        many.append(replace(records[i % len(records)], name=name))
    start = time.perf_counter()
    write_index(folder, BatchSummary(tuple(many), ()), "many")
    size = (folder / "index.html").stat().st_size / 2**20
    print(f"page of 1,000 recordings: {size:.1f} MB, written in {time.perf_counter() - start:.1f} s")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        print("page: not opened, since there is no Chromium")
        return
    probe = (
        "<script>addEventListener('load', () => { const t = performance.now();"
        "document.querySelector('[data-column=\"0\"]').click(); document.body.offsetHeight;"
        "const s = performance.now() - t; document.title = `loaded ${Math.round(t)} ms, sorted ${Math.round(s)} ms`;"
        "});</script></body>"
    )
    page = folder / "probe.html"
    page.write_text((folder / "index.html").read_text().replace("</body>", probe))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=8000", "--dump-dom"]
    dom = subprocess.run([chromium, *flags, page.as_uri()], capture_output=True, text=True, check=False).stdout
    print(f"page: {dom.partition('<title>')[2].partition('</title>')[0]}")
