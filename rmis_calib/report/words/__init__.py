"""What a report says: a result as plain values and sentences, without markup."""
