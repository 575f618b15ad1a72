import numpy as np
import pytest
from test_prediction import IMAGES, untrained

from thesis_repro import InputError, cityscapes
from thesis_repro.segmentation import prediction, quality, training

pytestmark = pytest.mark.slow


def test_confusion_matrix_and_cityscapes_scores():
    true = np.array([[7, 7, 7, 11], [11, 0, 23, 255]], np.uint8)
    predicted = np.array([[7, 7, 11, 11], [11, 7, 5, 7]], np.uint8)
    confusion = quality.confusion_matrix(true, predicted)
    mean_iou, accuracy, table = quality.cityscapes_scores(confusion)

    assert (
        confusion.sum() == 7
        and confusion[7, 11] == 1
        and confusion[0, 7] == 1
        and confusion[23, 5] == 1
    )
    # 0 is not evaluated
    assert table["iou"].to_dict() == pytest.approx({"road": 2 / 3, "building": 2 / 3, "sky": 0})
    assert mean_iou == pytest.approx(4 / 9) and accuracy == pytest.approx(4 / 6)
    assert table.loc["building", ["pixels", "precision", "recall"]].tolist() == pytest.approx(
        [2, 2 / 3, 1]
    )


def test_quality_agrees_with_keras_and_with_a_plain_count():
    model = untrained(1)
    labels = np.random.default_rng(1).choice(np.array([7, 11, 23, 26], np.uint8), IMAGES.shape[:3])
    measured = quality.quality(model, IMAGES, labels, batch_size=3)
    model.compile("adam", training.total_loss(), metrics=training.metrics())
    expected = model.evaluate(
        training.Batches([(IMAGES, labels)], 3).dataset(), verbose=0, return_dict=True
    )
    predicted = prediction.predict(model, IMAGES)

    assert measured.iou_score == pytest.approx(expected["iou_score"], abs=1e-5)
    assert measured.f1_score == pytest.approx(expected["f1-score"], abs=1e-5)
    assert measured.accuracy == pytest.approx((predicted == labels).mean())
    # the library counts the 31 absent classes, which are hardly predicted, as perfect
    assert measured.iou_score > measured.mean_iou + 0.3
    with pytest.raises(InputError):
        quality.quality(model, IMAGES[:0], labels[:0])


@pytest.mark.real
def test_the_shipped_model_is_as_good_on_camvid_as_its_card_says(camvid_real):
    images, labels = cityscapes.load(cityscapes.pairs(camvid_real, "val"), 320)
    measured = quality.quality(prediction.load_shipped(), images, labels)
    card = (prediction.SHIPPED.parent / "README.md").read_text()

    assert len(images) == 101 and len(measured.classes) == 11
    assert (
        f"pixel accuracy **{measured.accuracy:.3f}**, mean IoU **{measured.mean_iou:.3f}**" in card
    )
    for name, row in measured.classes.iterrows():
        assert (
            f"| {name} | {row['id']:.0f} | " in card
            and f"| {row['iou']:.3f} | {row['precision']:.3f} |" in card
        )
