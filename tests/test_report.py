"""The page that shows an evaluation."""

import re
from collections import Counter
from dataclasses import replace

import imageio.v3 as iio
import numpy as np
import pytest

from tests.helpers.records import CONFIG, OLD, RETRIEVED, ROUNDS, STOPS, a_round, attempt
from utils.config import with_settings
from utils.errors import UserError
from utils.report import (
    GalleryItem,
    balanced,
    read_gallery,
    set_in_words,
    thinned,
    write_gallery,
    write_report,
)
from utils.result_formats import format_comparisons
from utils.result_records import FAILURES
from utils.results import compare, summarise
from utils.runs import REPOSITORY, this_python
from utils.statistics import FEW_ROUNDS
from utils.transforms import ImageGrasp


def report(tmp_path, rounds=ROUNDS, **more) -> str:
    path = tmp_path / "report.html"
    write_report(path, summarise(rounds, 0), rounds, compare(rounds, 0), CONFIG, **more)
    return path.read_text(encoding="utf-8")


def test_report_is_self_contained(tmp_path):
    image = np.full((40, 40, 3), 90, np.uint8)
    iio.imwrite(tmp_path / "round.gif", np.stack([image, image + 50]))
    page = report(
        tmp_path,
        gallery=[GalleryItem(image, "a <b>caption</b>", True), GalleryItem(image, "two", False)],
        videos=[(tmp_path / "round.gif", "round 0")],
        device="CPU",
    )
    assert not re.search(r"https?://|//cdn|@import|<script|<link", page)
    for source in re.findall(r"(?:src|href)=\"([^\"]*)", page):
        assert source.startswith("data:")
    assert page.count("data:image/png;base64") == 2 and page.count("data:image/gif;base64") == 1
    assert "a &lt;b&gt;caption&lt;/b&gt;" in page and "<b>caption" not in page
    assert "interrupted" not in page
    assert "evaluate.rounds=2" in page and f"{this_python()} evaluate.py" in page
    assert "Firm: share of the grasps" in page
    assert "heuristic: 3 of 6" in page and "1 collision on approach" in page
    assert "few rounds" in page  # two rounds give no verdict


def test_few_rounds_have_no_interval_on_the_page_as_in_the_table(tmp_path):
    (pair,) = compare(ROUNDS, 0)
    assert pair.cleared.rounds == 2 and "[" not in format_comparisons([pair])
    pages = []
    for count in (FEW_ROUNDS - 1, FEW_ROUNDS):
        cleared = replace(pair.cleared, rounds=count)
        one = replace(pair, success=None, cleared=cleared)
        path = tmp_path / f"{count}.html"
        write_report(path, summarise(ROUNDS, 0), ROUNDS, [one], CONFIG)
        page = path.read_text(encoding="utf-8")
        pages.append(page[page.index("Paired comparison") :].partition("<h2>")[0])
    few, enough = pages
    assert "−40 to −20" in enough and "whisker" in enough and "few rounds" not in enough
    assert "−40" not in few and "whisker" not in few
    assert re.search(r'class="value">−30\s+<span class="tag few rounds">few rounds', few)
    assert 'aria-label="random minus heuristic: −30, few rounds"' in few


def test_each_reason_has_a_colour_in_light_and_dark():
    layout = (REPOSITORY / "utils" / "report.html.j2").read_text()
    for reason in ("success", *FAILURES):
        assert len(re.findall(rf"--{reason}: #[0-9a-f]{{6}};", layout)) == 2, reason


def test_report_of_an_interrupted_run(tmp_path):
    page = report(tmp_path, ROUNDS[:3], interruption="interrupted: 3 of 4 rounds")
    assert "interrupted: 3 of 4 rounds" in page
    assert "nothing to show yet" in report(tmp_path, [])


@pytest.mark.parametrize(
    "name, controller",
    [("oracle", "open_loop"), ("oracle+ibvs", "ibvs"), ("mine:sees_all", "open_loop")],
)
def test_a_privileged_planner_is_a_bound_not_the_headline(tmp_path, name, controller):
    best = a_round(name, 0, 1, 1, [attempt("success")], "cleared")
    rounds = [*ROUNDS, replace(best, controller=controller)]
    page = report(tmp_path, rounds, privileged={"oracle", "mine:sees_all"})
    assert "succeed with <strong>heuristic" in page
    assert f"{name}, which knows the true scene: 100 %" in page
    assert f"succeed with <strong>{name}" in report(tmp_path, rounds), "unless it is fair"


def test_planners_that_are_as_good_as_the_best_are_named_beside_it(tmp_path):
    rounds = [one for one in ROUNDS if one.policy == "heuristic"]
    others = [replace(one, policy="twin") for one in rounds]
    assert "the same share with" not in report(tmp_path, rounds)
    assert "<br>the same share with twin<" in report(tmp_path, [*rounds, *others])


def test_where_one_object_is_wanted_the_headline_is_the_share_of_targets(tmp_path):
    """All seven grasps succeed; two of three targets are retrieved, Wilson's interval [21, 94]."""
    page = report(tmp_path, RETRIEVED)
    assert re.search(r"<b>67<small> % \[21–94\]</small></b>\s*<span[^>]*>of targets are", page)
    assert "retrieved with <strong>heuristic</strong>, after 2.5 picks on average" in page
    measures = re.findall(r'class="measure">([^<]*)', page)
    assert measures == ["target in hand, %", "success, %"]
    assert "heuristic: 2 of 3" in page and "heuristic: 7 of 7" in page
    assert "Target in hand:" not in report(tmp_path)
    other = [replace(record, policy="lucky", target_in_hand=True) for record in RETRIEVED]
    other = [replace(record, attempts=(attempt("missed"),)) for record in other]
    both = report(tmp_path, [*RETRIEVED, *other])
    assert "retrieved with <strong>lucky" in both, "the best retrieves most"
    (pair,) = compare([*RETRIEVED, *other], 0)
    assert pair.cleared is None and pair.success.value == -1.0


def test_a_floating_hands_chances_are_said_to_be_the_arms(tmp_path):
    graded = attempt("success"), attempt("missed")
    seen = ImageGrasp(pixel=np.zeros(2), angle=0.0, width=0.05, depth=0.5, quality=0.9)
    graded = [replace(one, grasp=seen) for one in graded]
    rounds = [replace(a_round("heuristic", 0, 2, 1, graded), calibration=(1.0, 0.0))]
    words = "for the floating hand they are scores that only rank"
    for arm, said in (("none", True), ("panda", False)):
        config = with_settings(CONFIG, "robot", {"arm": arm})
        path = tmp_path / f"{arm}.html"
        write_report(path, summarise(rounds, 0), rounds, [], config)
        page = path.read_text(encoding="utf-8")
        assert "How sure the planners are" in page and (words in page) == said


def test_each_depth_noise_has_its_own_cards(tmp_path):
    noisy = [replace(record, depth_noise="realsense") for record in ROUNDS]
    page = report(tmp_path, [*noisy, *ROUNDS])
    heading = '<h3>pile <span class="soft">· {}</span></h3>'
    places = [
        page.index(heading.format(words)) for words in ("box, realsense depth", "box, clean depth")
    ]
    assert places == sorted(places) and "<th>depth</th>" in page
    assert "<th>depth</th>" not in report(tmp_path)


def test_report_refuses_bad_videos(tmp_path):
    with pytest.raises(UserError, match=r"\.gif, \.mp4"):
        report(tmp_path, videos=[(tmp_path / "a.avi", "")])
    with pytest.raises(UserError, match="cannot read"):
        report(tmp_path, videos=[(tmp_path / "a.gif", "")])


def test_what_stopped_the_arm_is_on_the_page(tmp_path):
    page = report(tmp_path, [*ROUNDS, *STOPS])
    assert "Why attempts failed" in page and OLD.format(104) in page and "8.0, 14.0" in page
    without = report(tmp_path, ROUNDS[:1])
    assert "Why attempts failed" not in without and "turn ms" not in without


def test_objects_that_fail_most_are_on_the_page(tmp_path):
    failed = [replace(attempt("missed"), aimed="mug"), replace(attempt("success"), aimed="mug")]
    page = report(tmp_path, [*ROUNDS, a_round("heuristic", 5, 5, 1, failed)])
    assert "Objects at which most attempts failed" in page
    assert '<td>mug</td><td class="n">1 of 2</td><td class="n">–</td>' in page
    assert "Objects at which" not in report(tmp_path, ROUNDS)


def test_half_of_the_pictures_are_failures_of_each_policy_in_turn():
    image = np.zeros((2, 2, 3), np.uint8)

    def items(policy, success, count):
        return [GalleryItem(image, f"{policy} {k}", success, policy) for k in range(count)]

    pictures = [*items("a", False, 5), *items("b", False, 1), *items("a", True, 9)]
    chosen = [item.caption for item in balanced(pictures, 6)]
    assert chosen == ["a 0", "b 0", "a 1", "a 0", "a 1", "a 2"]
    assert len(balanced(pictures[:6], 4)) == 4, "failures fill up where successes lack"


def test_scenarios_sets_noises_and_reasons_take_turns_on_the_page():
    """Of 200 failures, nearly all of them of the first scenario, policy and reason."""
    image = np.zeros((2, 2, 3), np.uint8)
    pictures = [
        GalleryItem(image, f"{n}", False, policy, (scenario, objects, noise), reason)
        for policy in ("a", "b")
        for scenario in ("isolated", "pile")
        for objects in ("box", "primitives")
        for noise in ("none", "realsense")
        for reason in ("collision", "missed", "slipped")
        for n in range(160 if (policy, scenario, reason) == ("a", "isolated", "collision") else 1)
    ]
    chosen = balanced(pictures, 12)
    assert len(chosen) == 12
    for counts in (
        Counter(item.policy for item in chosen),
        *(Counter(item.kind[place] for item in chosen) for place in range(3)),
    ):
        assert sorted(counts.values()) == [6, 6], counts
    assert sorted(Counter(item.reason for item in chosen).values()) == [4, 4, 4]


def test_the_pictures_that_a_report_may_show_are_kept_for_a_resumed_run(tmp_path):
    path = tmp_path / "gallery.npz"
    write_gallery(path, [], 3)
    assert not path.exists() and read_gallery(path) == []
    image = np.zeros((4, 6, 3), np.uint8)
    kinds = [("pile", "box", "none"), ("isolated", "box", "none")]
    pictures = [
        GalleryItem(image, f"{n}", n % 2 == 0, "heuristic", kinds[n % 3 == 0], "missed")
        for n in range(60)
    ]
    write_gallery(path, pictures, 3)
    kept = read_gallery(path)
    assert sum(not item.success for item in kept) == 24 and len(kept) == 27
    names = [item.caption for item in balanced(kept, 3)]
    assert names == [item.caption for item in balanced(pictures, 3)]
    assert {item.kind for item in kept} == set(kinds) and kept[0].reason == "missed"
    earlier = tmp_path / "earlier.npz"  # whole frames, without kinds and reasons
    np.savez_compressed(earlier, image=[image], caption=["a"], success=[True], policy=["b"])
    assert read_gallery(earlier) == []
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(UserError, match="gallery.npz: cannot be read as pictures"):
        read_gallery(path)


def test_pictures_that_are_thinned_as_they_come_leave_the_same_choice():
    """Of 400, among them 300 alike, 24 failures of a kind and 5 successes are kept."""
    image = np.zeros((2, 2, 3), np.uint8)
    every = [
        GalleryItem(image, f"{n}", n % 4 == 0, "ab"[n % 8 == 1], ("pile", "box", "none"), "missed")
        for n in range(400)
    ]
    kept = []
    for item in every:
        kept = thinned([*kept, item], 5)
    assert Counter((item.success, item.policy) for item in kept) == {
        (True, "a"): 5, (False, "a"): 24, (False, "b"): 24,
    }  # fmt: skip
    chosen, all_of_them = ([item.caption for item in balanced(some, 5)] for some in (kept, every))
    assert chosen == all_of_them


def test_folders_of_one_last_name_are_told_apart():
    sets = ["scans/mugs", "meshes/mugs", "meshes/jars", "box", "my:set"]
    told = [set_in_words(one, sets) for one in sets]
    assert told == ["scans/mugs", "meshes/mugs", "jars", "box", "my:set"]
    assert set_in_words("meshes/jars + scans/mugs + box", sets) == "jars + scans/mugs + box"


def test_a_run_that_went_on_at_another_commit_names_both_on_its_page(tmp_path):
    assert "written at" not in report(tmp_path)
    (tmp_path / "environment.json").write_text('{"commit": "aaaa", "dirty": false}')
    assert re.search(r"<dt>commit</dt><dd>aaaa.*; written at ", report(tmp_path))


def test_flipped_bytes_of_kept_pictures_are_one_sentence(tmp_path):
    path, rng = tmp_path / "gallery.npz", np.random.default_rng(0)
    image = rng.integers(0, 255, (4, 6, 3), np.uint8)
    write_gallery(path, [GalleryItem(image, "a", False, "b", ("pile", "box", "none"), "missed")], 3)
    whole, refused = path.read_bytes(), 0
    for place in rng.integers(0, len(whole), 150):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 255]) + whole[place + 1 :])
        try:
            read_gallery(path)
        except UserError as error:
            assert "cannot be read as pictures" in str(error)
            refused += 1
    assert refused > 75
