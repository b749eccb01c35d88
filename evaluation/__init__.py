"""Who is stronger, how sure are we, and may it be promoted."""
