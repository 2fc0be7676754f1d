"""Forms that the page asks to fill in: consent, the scales of NASA-TLX, free text."""

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import fmean
from typing import Any, NamedTuple

from sb3_chac.cockpit.devices.browser import BadMessage, read_json

STEP, MOST = 5, 100  # of a scale
AGREE, DECLINE = "I agree", "I do not agree"


@dataclass(frozen=True)
class Question:
    """
    Question of a form.

    :param name: of the answer
    :param text: that is read
    :param ends: what 0 and 100 of its scale mean; None for free text
    """

    name: str
    text: str
    ends: tuple[str, str] | None = None


class Answer(NamedTuple):
    """Answer to a form: the button pressed, and values by the names of the questions."""

    choice: str
    values: dict[str, int | str]


@dataclass(frozen=True)
class Form:
    """
    Form that is shown until it is answered.

    :param title: its heading
    :param text: to read
    :param questions: scales must be answered, free text may stay empty
    :param choices: names of the buttons
    """

    title: str
    text: str = ""
    questions: tuple[Question, ...] = ()
    choices: tuple[str, ...] = ("Continue",)

    def parse(self, text: str, number: int) -> Answer:
        """
        Parse an answer of the page.

        :param text: JSON, ``{"form": number, "choice": button, "values": {name: 0 to 100 in steps of 5, or text}}``
        :param number: of this form: an answer to another one is refused
        :raises BadMessage: for everything else
        """
        match data := read_json(text):
            case {"form": int(form), "choice": str(choice), "values": dict(values)} if len(data) == 3:
                if form != number:
                    raise BadMessage("that form is not asked any more")
                if choice not in self.choices or set(values) != {question.name for question in self.questions}:
                    raise BadMessage("unknown choice or question, or one without an answer")
                return Answer(
                    choice, {question.name: _checked(question, values[question.name]) for question in self.questions}
                )
        raise BadMessage("unknown answer")


def _checked(question: Question, value: Any) -> int | str:
    if question.ends is None:
        if not isinstance(value, str):
            raise BadMessage(f"{question.name} is answered by text")
    elif isinstance(value, bool) or not isinstance(value, int) or value not in range(0, MOST + 1, STEP):
        raise BadMessage(f"{question.name} is answered by 0 to {MOST} in steps of {STEP}")
    return value


# Hart and Staveland (1988), with the words of NASA's form
LOW_TO_HIGH = ("very low", "very high")
TLX = (
    Question("mental", "Mental demand: how mentally demanding was the task?", LOW_TO_HIGH),
    Question("physical", "Physical demand: how physically demanding was the task?", LOW_TO_HIGH),
    Question("temporal", "Temporal demand: how hurried or rushed was the pace of the task?", LOW_TO_HIGH),
    Question("performance", "Performance: how successful were you in what you were asked to do?", ("perfect", "failure")),
    Question("effort", "Effort: how hard did you have to work to reach this performance?", LOW_TO_HIGH),
    Question("frustration", "Frustration: how insecure, irritated, stressed or annoyed were you?", LOW_TO_HIGH),
)


def raw_tlx(values: dict[str, Any]) -> float:
    """
    Compute the raw TLX.

    :param values: of the six scales
    :return: their mean, 0 to 100
    """
    return fmean(values[scale.name] for scale in TLX)


def consent_form(title: str, text: str) -> Form:
    """
    Make the form that comes first.

    :param title: of the study
    :param text: what is agreed to
    """
    return Form(title, text, choices=(AGREE, DECLINE))


def questionnaire(title: str, questions: Iterable[str]) -> Form:
    """
    Make the form that follows a condition: the scales of NASA-TLX, then free text.

    :param title: its heading
    :param questions: of the protocol
    """
    scales = "Think of the part that you have just driven. Choose a place on each scale; to write something is up to you."
    return Form(title, scales, (*TLX, *(Question(text, text) for text in questions)))
