from .answer import LiveAnswer as LiveAnswer
from .session import Session as Session
